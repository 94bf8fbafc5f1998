"""The networks of one learner update (docs/model.md) as plain functions of arrays, for JAX and for PyTorch.

Agents `qmix` and `qedgix`: flat observation, one-hot identity, mean aggregation, QMIX mixer, double Q-learning with TD(lambda). Edges are dense
V x V masks, and EdgeConv uses its factored form, so that nothing but LayerNorm and ReLU is computed per edge.

B episodes, T slots, M UAVs, N users, V = M + N nodes, H hidden width.
"""
import math

import numpy as np

M, N, A, K, H, EDGE, MIX, HYPER = 3, 5, 8, 80, 64, 96, 32, 64
V, WIDTH = M + N, 2 * M + 3 * N
RANGE, GAMMA, LAMBDA, RATE, CLIP = 0.28, 0.99, 0.6, 1e-3, 10.0


def shapes(algorithm):
    """Names and shapes of the parameters; weights are (inputs, outputs)."""
    linear = {"fc": (WIDTH + A + M, H), "ih": (H, 3 * H), "hh": (H, 3 * H), "mix_w1": (WIDTH, HYPER), "mix_w1b": (HYPER, M * MIX),
              "mix_b1": (WIDTH, MIX), "mix_w2": (WIDTH, HYPER), "mix_w2b": (HYPER, MIX), "mix_b2": (WIDTH, MIX), "mix_b2b": (MIX, 1)}
    norms = {}
    if algorithm == "qedgix":
        linear |= {"own": (H, H), "user": (WIDTH, H), "head1": (2 * H, H), "head2": (H, A)}
        norms["head"] = H
        for layer in "12":
            linear |= {f"edge{layer}": (2 * H, EDGE), f"out{layer}": (EDGE, H)}
            norms[f"edge{layer}"] = EDGE
    else:
        linear["head"] = (H, A)
    out = {}
    for name, (i, o) in linear.items():
        out[name + ".w"], out[name + ".b"] = (i, o), (o,)
    for name, width in norms.items():
        out[name + ".scale"], out[name + ".shift"] = (width,), (width,)
    return out


def initial(algorithm, seed):
    rng = np.random.default_rng(seed)
    bound = lambda shape: 1 / math.sqrt(shape[0])
    return {k: np.ones(s, np.float32) if k.endswith("scale") else rng.uniform(-bound(s), bound(s), s).astype(np.float32)
            for k, s in shapes(algorithm).items()}


def random_batch(batch, seed=0):
    """Episodes of UAVs that fly at random from the centre."""
    rng = np.random.default_rng(seed)
    actions = rng.integers(0, A, (batch, K, M))
    turn = actions * math.pi / 4
    moves = 0.04 * np.stack([np.cos(turn), np.sin(turn)], -1)
    uavs = np.full((batch, K + 1, M, 2), 0.5)
    for t in range(K):
        uavs[:, t + 1] = np.clip(uavs[:, t] + moves[:, t], 0, 1)
    users = rng.random((batch, N, 2))
    near = np.linalg.norm(users[:, None, :, None] - uavs[:, :, None], axis=-1).min(-1) <= 0.12
    aoi = np.zeros((batch, K + 1, N))
    for t in range(K):
        aoi[:, t + 1] = np.where(near[:, t + 1], 0, aoi[:, t] + 1)
    f = lambda x: x.astype(np.float32)
    return dict(uavs=f(uavs), users=f(users), aoi=f(aoi), actions=actions, reward=f(-aoi[:, 1:].mean(-1) / K))


class Model:
    """The loss in the operations `x` of one library; see `jax_peer.py` and `torch_peer.py`."""

    def __init__(self, algorithm, x):
        self.algorithm, self.x = algorithm, x

    def linear(self, p, name, v):
        return self.x.linear(v, p[name + ".w"], p[name + ".b"])

    def norm_relu(self, p, name, v):
        centred = v - self.x.row_mean(v)
        rstd = 1 / self.x.sqrt(self.x.row_mean(centred * centred) + 1e-5)
        return self.x.relu(centred * rstd * p[name + ".scale"] + p[name + ".shift"])

    def scene(self, b):
        x = self.x
        aoi = b["aoi"] / K
        steps = aoi.shape[1]
        users = x.broadcast(b["users"][:, None], (aoi.shape[0], steps, N, 2))
        at = x.cat([b["uavs"], users], 2)
        rel = at[:, :, None] - at[:, :, :, None]
        seen = x.number((rel * rel).sum(-1) <= RANGE * RANGE)
        ages = x.broadcast(aoi[:, :, None, :, None], (aoi.shape[0], steps, V, N, 1))
        to_uavs = rel[:, :, :, :M] * seen[:, :, :, :M, None]
        to_users = x.cat([rel[:, :, :, M:], ages], -1) * seen[:, :, :, M:, None]
        flat = lambda v: v.reshape(v.shape[0], v.shape[1], V, -1)
        observed = x.cat([flat(to_uavs), flat(to_users)], -1)
        state = x.cat([b["uavs"].reshape(aoi.shape[0], steps, -1), x.cat([users, aoi[..., None]], -1).reshape(aoi.shape[0], steps, -1)], -1)
        return observed, state, seen * (1 - x.eye(V))

    def edge_conv(self, p, layer, v, links, outputs):
        # LayerNorm subtracts the mean of every edge; it is subtracted from the weights instead.
        centred = lambda v: v - v.mean(-1, keepdims=True)
        w = p[f"edge{layer}.w"]
        own = v[:, :, :outputs] @ centred(w[:H] - w[H:]) + centred(p[f"edge{layer}.b"])
        other = v @ centred(w[H:])
        links = links[:, :, :outputs]
        degree = links.sum(-1, keepdims=True)
        shares = links / self.x.at_least_one(degree)
        total = self.x.edges(own, other, shares, p[f"edge{layer}.scale"], p[f"edge{layer}.shift"])
        return self.linear(p, f"out{layer}", total) * self.x.number(degree > 0)

    def values(self, p, scene, last):
        x = self.x
        observed, _, links = scene
        batch, steps = observed.shape[:2]
        identity = x.broadcast(x.eye(M), (batch, steps, M, M))
        inputs = x.relu(self.linear(p, "fc", x.cat([observed[:, :, :M], last, identity], -1)))
        h = x.walk(self.linear(p, "ih", inputs), p["hh.w"], p["hh.b"])
        if self.algorithm == "qmix":
            return self.linear(p, "head", h)
        nodes = x.leaky(x.cat([self.linear(p, "own", h), self.linear(p, "user", observed[:, :, M:])], 2))
        nodes = x.relu(self.edge_conv(p, "1", nodes, links, V))
        nodes = self.edge_conv(p, "2", nodes, links, M)
        return self.linear(p, "head2", self.norm_relu(p, "head", self.linear(p, "head1", x.cat([h, nodes], -1))))

    def mix(self, p, q, state):
        x = self.x
        hyper = lambda name: self.linear(p, name + "b", x.relu(self.linear(p, name, state)))
        w1 = abs(hyper("mix_w1")).reshape(state.shape[0], state.shape[1], M, MIX)
        hidden = x.elu((q[..., None] * w1).sum(2) + self.linear(p, "mix_b1", state))
        return (hidden * abs(hyper("mix_w2"))).sum(-1) + hyper("mix_b2")[..., 0]

    def loss(self, p, target, b):
        x = self.x
        scene = self.scene(b)
        state = scene[1]
        taken = x.one_hot(b["actions"], A)
        last = x.cat([x.zeros_like(taken[:, :1]), taken], 1)
        q = self.values(p, scene, last)
        best = x.one_hot(x.argmax(x.stop(q)), A)
        future = x.stop(self.mix(target, (self.values(target, scene, last) * best).sum(-1), state))
        returns, value = [], future[:, -1]
        for t in reversed(range(K)):
            value = b["reward"][:, t] + GAMMA * (LAMBDA * value + (1 - LAMBDA) * future[:, t + 1])
            returns.append(value)
        total = self.mix(p, (q[:, :-1] * taken).sum(-1), state[:, :-1])
        error = total - x.stack(returns[::-1], 1)
        return 0.5 * (error * error).mean()
