"""The update in JAX: one jit, with Adam and the clipping of the gradient. The edges and the GRU have hand-written gradients, so that
nothing per edge is stored and the weights of the GRU get their gradient from one product. `row_sum` and `total` are written so that XLA
compiles them to vector instructions on a CPU."""
import jax
import jax.numpy as jnp

import model


def row_sum(x, lanes=16):
    """Sum over the last axis."""
    return sum(x[..., i:i + lanes] for i in range(0, x.shape[-1], lanes)).sum(-1)


def total(x):
    """Sum over all axes but the last."""
    x = x.reshape(-1, x.shape[-1])
    return jnp.ones(x.shape[0]) @ x


def normalised(own, other_j):
    """Edges from node j to all nodes: normalised values and 1 / standard deviation. The inputs have mean 0."""
    z = own + other_j[:, :, None]
    rstd = jax.lax.rsqrt(row_sum(z * z) / z.shape[-1] + 1e-5)[..., None]
    return z * rstd, rstd


@jax.custom_vjp
def edges(own, other, shares, scale, shift):
    """Sum over j of shares_ij relu(LayerNorm(own_i + other_j))."""
    return sum(shares[:, :, :, j, None] * jax.nn.relu(normalised(own, other[:, :, j])[0] * scale + shift) for j in range(other.shape[2]))


def edges_backward(saved, d):
    own, other, shares, scale, shift = saved
    d_own, d_other, d_scale, d_shift = 0, [], 0, 0
    for j in range(other.shape[2]):
        n, rstd = normalised(own, other[:, :, j])
        d_out = jnp.where(n * scale + shift > 0, d * shares[:, :, :, j, None], 0)
        d_scale, d_shift, d_n = d_scale + d_out * n, d_shift + d_out, d_out * scale
        d_z = rstd * (d_n - n * (row_sum(d_n * n) / n.shape[-1])[..., None])
        d_own += d_z
        d_other.append(d_z.sum(2))
    return d_own, jnp.stack(d_other, 2), jnp.zeros_like(shares), total(d_scale), total(d_shift)


edges.defvjp(lambda *a: (edges(*a), a), edges_backward)


def gates(i, g):
    H = model.H
    reset_update = jax.nn.sigmoid(i[..., :2 * H] + g[..., :2 * H])
    r, z = reset_update[..., :H], reset_update[..., H:]
    return r, z, jnp.tanh(i[..., 2 * H:] + r * g[..., 2 * H:])


def walk_saving(inputs, w, b):
    def step(h, i):
        g = h @ w + b
        r, z, n = gates(i, g)
        after = (1 - z) * n + z * h
        return after, (after, r, z, n, g[..., 2 * model.H:], h)

    first = jnp.zeros((inputs.shape[0], model.M, model.H))
    return jax.lax.scan(step, first, inputs.swapaxes(0, 1))[1]


@jax.custom_vjp
def walk(inputs, w, b):
    """The states of a GRU; inputs (B, T, M, 3 H)."""
    return walk_saving(inputs, w, b)[0].swapaxes(0, 1)


def walk_forward(inputs, w, b):
    saved = walk_saving(inputs, w, b)
    return saved[0].swapaxes(0, 1), (w, saved)


def walk_backward(saved, d):
    w, (_, r, z, n, g, h) = saved
    to_n, to_z, to_r = (1 - z) * (1 - n * n), (h - n) * z * (1 - z), g * r * (1 - r)

    def step(d_h, at):
        d, to_n, to_z, to_r, r, z = at
        d_h = d_h + d
        d_n = d_h * to_n
        d_i = jnp.concatenate([d_n * to_r, d_h * to_z, d_n], -1)
        d_g = jnp.concatenate([d_i[..., :2 * model.H], d_n * r], -1)
        return d_h * z + d_g @ w.T, (d_i, d_g)

    d_i, d_g = jax.lax.scan(step, jnp.zeros_like(h[0]), (d.swapaxes(0, 1), to_n, to_z, to_r, r, z), reverse=True)[1]
    rows = lambda x: x.reshape(-1, x.shape[-1])
    return d_i.swapaxes(0, 1), rows(h).T @ rows(d_g), total(d_g)


walk.defvjp(walk_forward, walk_backward)


class Ops:
    sqrt, relu, elu, stack = jnp.sqrt, jax.nn.relu, jax.nn.elu, staticmethod(jnp.stack)
    cat, broadcast, eye = staticmethod(jnp.concatenate), staticmethod(jnp.broadcast_to), staticmethod(jnp.eye)
    stop, zeros_like = staticmethod(jax.lax.stop_gradient), staticmethod(jnp.zeros_like)
    leaky = staticmethod(lambda v: jax.nn.leaky_relu(v, 0.01))
    number = staticmethod(lambda v: v.astype(jnp.float32))
    at_least_one = staticmethod(lambda v: jnp.maximum(v, 1))
    one_hot = staticmethod(jax.nn.one_hot)
    argmax = staticmethod(lambda v: v.argmax(-1))
    edges, walk = staticmethod(edges), staticmethod(walk)


def loss_and_gradient(algorithm, p, target, b):
    loss, grads = jax.value_and_grad(model.Model(algorithm, Ops).loss)(p, target, b)
    return float(loss), grads


def make(algorithm, batch):
    """A function that makes one update and waits for it."""
    net = model.Model(algorithm, Ops)

    @jax.jit
    def update(p, target, m, v, step, b):
        loss, g = jax.value_and_grad(net.loss)(p, target, b)
        norm = jnp.sqrt(sum((x * x).sum() for x in g.values()))
        scale = jnp.minimum(1, model.CLIP / (norm + 1e-6))
        out, step = ({}, {}, {}), step + 1
        for k, x in g.items():
            x = x * scale
            m_k, v_k = 0.9 * m[k] + 0.1 * x, 0.999 * v[k] + 0.001 * x * x
            moved = model.RATE * (m_k / (1 - 0.9**step)) / (jnp.sqrt(v_k / (1 - 0.999**step)) + 1e-8)
            out[0][k], out[1][k], out[2][k] = p[k] - moved, m_k, v_k
        return *out, step, loss

    p, target = (jax.tree.map(jnp.asarray, model.initial(algorithm, seed)) for seed in (1, 2))
    zero = jax.tree.map(jnp.zeros_like, p)
    b = jax.tree.map(jnp.asarray, model.random_batch(batch))
    state = [p, zero, zero, 0.0]

    def run():
        p, m, v, step, loss = update(state[0], target, state[1], state[2], state[3], b)
        state[:] = [p, m, v, step]
        return float(loss)

    return run
