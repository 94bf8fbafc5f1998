"""The update in JAX: one jit, with Adam and the clipping of the gradient. The edges and the GRU have hand-written gradients, so that
nothing per edge is stored and the weights of the GRU get their gradient from one product. `row_sum` and `total` are written so that XLA
compiles them to vector instructions on a CPU. XLA runs most loops on one thread, so each thread is a device with a share of the batch,
which it takes in chunks that fit its cache; the fusions of YNNPACK, the default, would take twice as long."""
import os

threads = len(os.sched_getaffinity(0))
os.environ.setdefault("XLA_FLAGS", f"--xla_cpu_experimental_ynn_fusion_type= --xla_force_host_platform_device_count={threads}")

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


@jax.custom_vjp
def linear(x, w, b):
    return x @ w + b


def linear_backward(saved, d):
    x, w = saved
    rows = lambda x: x.reshape(-1, x.shape[-1])
    return d @ w.T, rows(x).T @ rows(d), total(d)


linear.defvjp(lambda x, w, b: (x @ w + b, (x, w)), linear_backward)


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
    reset_update = 0.5 * jnp.tanh(0.5 * (i[..., :2 * H] + g[..., :2 * H])) + 0.5
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
    row_mean = staticmethod(lambda v: (row_sum(v) / v.shape[-1])[..., None])
    linear, edges, walk = staticmethod(linear), staticmethod(edges), staticmethod(walk)


def loss_and_gradient(algorithm, p, target, b):
    loss, grads = jax.value_and_grad(model.Model(algorithm, Ops).loss)(p, target, b)
    return float(loss), grads


# Maximum number of episodes of a chunk.
CHUNK = 8


def make(algorithm, batch):
    """A function that makes one update and waits for it."""
    net = model.Model(algorithm, Ops)
    devices = jax.device_count()
    share, rest = divmod(batch, devices)
    if rest:
        raise SystemExit(f"--batch {batch}: expected a multiple of {devices}, the number of threads")
    chunks = next(n for n in range(-(-share // CHUNK), share + 1) if share % n == 0)

    def gradient(p, target, b):
        def add(sums, chunk):
            return jax.tree.map(jnp.add, sums, jax.value_and_grad(net.loss)(p, target, chunk)), None

        zero = jnp.zeros(()), jax.tree.map(jnp.zeros_like, p)
        split = jax.tree.map(lambda x: x.reshape(chunks, -1, *x.shape[1:]), b)
        sums = jax.lax.scan(add, zero, split)[0]
        return jax.lax.pmean(jax.tree.map(lambda x: x / chunks, sums), "thread")

    def update(p, target, m, v, step, b):
        loss, g = gradient(p, target, b)
        norm = jnp.sqrt(sum((x * x).sum() for x in g.values()))
        scale = jnp.minimum(1, model.CLIP / (norm + 1e-6))
        out, step = ({}, {}, {}), step + 1
        for k, x in g.items():
            x = x * scale
            m_k, v_k = 0.9 * m[k] + 0.1 * x, 0.999 * v[k] + 0.001 * x * x
            moved = model.RATE * (m_k / (1 - 0.9**step)) / (jnp.sqrt(v_k / (1 - 0.999**step)) + 1e-8)
            out[0][k], out[1][k], out[2][k] = p[k] - moved, m_k, v_k
        return *out, step, loss

    spec, mesh = jax.sharding.PartitionSpec, jax.make_mesh((devices,), ("thread",))
    whole = spec()
    shared = jax.shard_map(update, mesh=mesh, in_specs=(whole,) * 5 + (spec("thread"),), out_specs=whole, check_vma=False)
    update = jax.jit(shared)
    place = lambda tree, where: jax.tree.map(lambda x: jax.device_put(x, jax.sharding.NamedSharding(mesh, where)), tree)
    p, target = (place(model.initial(algorithm, seed), whole) for seed in (1, 2))
    zero = jax.tree.map(jnp.zeros_like, p)
    b = place(model.random_batch(batch), spec("thread"))
    state = [p, zero, zero, jnp.zeros(())]

    def run():
        p, m, v, step, loss = update(state[0], target, state[1], state[2], state[3], b)
        state[:] = [p, m, v, step]
        return float(loss)

    return run
