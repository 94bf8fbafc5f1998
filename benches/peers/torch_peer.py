"""The update in PyTorch, eager or compiled."""
import torch
import torch.nn.functional as F

import model


class Ops:
    sqrt, relu, elu, stack = torch.sqrt, F.relu, F.elu, staticmethod(torch.stack)
    cat, eye, zeros_like = staticmethod(torch.cat), staticmethod(torch.eye), staticmethod(torch.zeros_like)
    broadcast = staticmethod(lambda v, shape: v.expand(shape))
    stop = staticmethod(lambda v: v.detach())
    leaky = staticmethod(lambda v: F.leaky_relu(v, 0.01))
    number = staticmethod(lambda v: v.float())
    at_least_one = staticmethod(lambda v: v.clamp(min=1))
    one_hot = staticmethod(lambda v, n: F.one_hot(v, n).float())
    argmax = staticmethod(lambda v: v.argmax(-1))
    linear = staticmethod(lambda v, w, b: F.linear(v, w.T, b))
    row_mean = staticmethod(lambda v: v.mean(-1, keepdim=True))

    @staticmethod
    def edges(own, other, shares, scale, shift):
        z = own[:, :, :, None] + other[:, :, None]
        rstd = torch.rsqrt((z * z).mean(-1, keepdim=True) + 1e-5)
        return (F.relu(z * rstd * scale + shift) * shares[..., None]).sum(3)

    @staticmethod
    def walk(inputs, w, b):
        H = model.H
        h, out = torch.zeros(inputs.shape[0], model.M, H), []
        for i in inputs.unbind(1):
            g = h @ w + b
            r, z = torch.sigmoid(i[..., :H] + g[..., :H]), torch.sigmoid(i[..., H:2 * H] + g[..., H:2 * H])
            n = torch.tanh(i[..., 2 * H:] + r * g[..., 2 * H:])
            h = (1 - z) * n + z * h
            out.append(h)
        return torch.stack(out, 1)


def tensors(numbers):
    return {k: torch.from_numpy(v.copy()) for k, v in numbers.items()}


def loss_and_gradient(algorithm, p, target, b):
    p = {k: v.requires_grad_() for k, v in tensors(p).items()}
    loss = model.Model(algorithm, Ops).loss(p, tensors(target), tensors(b))
    loss.backward()
    return loss.item(), {k: v.grad for k, v in p.items()}


def make(algorithm, batch, compiled, threads):
    """A function that makes one update."""
    torch.set_num_threads(threads)
    net = model.Model(algorithm, Ops)
    p = {k: v.requires_grad_() for k, v in tensors(model.initial(algorithm, 1)).items()}
    target, b = tensors(model.initial(algorithm, 2)), tensors(model.random_batch(batch))
    optimiser = torch.optim.Adam(p.values(), lr=model.RATE)
    loss_of = torch.compile(net.loss) if compiled else net.loss

    def run():
        loss = loss_of(p, target, b)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(p.values(), model.CLIP)
        optimiser.step()
        return loss.item()

    return run
