"""The update in JAX: one jit, with Adam and the clipping of the gradient."""
import jax
import jax.numpy as jnp

import model


class Ops:
    sqrt, relu, elu, stack = jnp.sqrt, jax.nn.relu, jax.nn.elu, staticmethod(jnp.stack)
    cat, broadcast, eye = staticmethod(jnp.concatenate), staticmethod(jnp.broadcast_to), staticmethod(jnp.eye)
    stop, zeros_like = staticmethod(jax.lax.stop_gradient), staticmethod(jnp.zeros_like)
    leaky = staticmethod(lambda v: jax.nn.leaky_relu(v, 0.01))
    number = staticmethod(lambda v: v.astype(jnp.float32))
    at_least_one = staticmethod(lambda v: jnp.maximum(v, 1))
    one_hot = staticmethod(jax.nn.one_hot)
    argmax = staticmethod(lambda v: v.argmax(-1))

    @staticmethod
    def walk(inputs, w, b):
        H = model.H

        def step(h, i):
            g = h @ w + b
            r, z = jax.nn.sigmoid(i[..., :H] + g[..., :H]), jax.nn.sigmoid(i[..., H:2 * H] + g[..., H:2 * H])
            n = jnp.tanh(i[..., 2 * H:] + r * g[..., 2 * H:])
            h = (1 - z) * n + z * h
            return h, h

        first = jnp.zeros((inputs.shape[0], model.M, H))
        return jax.lax.scan(step, first, inputs.swapaxes(0, 1))[1].swapaxes(0, 1)


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
