"""Compares one learner update of Qedgix with JAX and PyTorch programs of the same sizes, alternating in one run.

    python benches/peers/run.py --qedgix target/release/qedgix --algorithm qedgix

Prints the median seconds of each and how many times as long as Qedgix it takes (the median over rounds of the ratio within a round).
"""
import argparse
import json
import os
import statistics
import subprocess
import sys
import time


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--qedgix", default="target/release/qedgix", help="the program [default: target/release/qedgix]")
    p.add_argument("--algorithm", choices=["qedgix", "qmix"], default="qedgix")
    p.add_argument("--batch", type=int, default=128, help="episodes [default: 128]")
    p.add_argument("--rounds", type=int, default=10, help="alternations [default: 10]")
    p.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)), help="[default: all cores]")
    p.add_argument("--peers", default="jax,torch,torch-compiled", help="[default: jax,torch,torch-compiled]")
    p.add_argument("--check", action="store_true", help="only compare the loss and gradients of the two programs")
    c = p.parse_args()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:c.threads])
    if c.check:
        return check(c.algorithm)
    peers = {}
    for name in c.peers.split(","):
        if name == "jax":
            import jax_peer
            peers[name] = jax_peer.make(c.algorithm, c.batch)
        else:
            import torch_peer
            peers[name] = torch_peer.make(c.algorithm, c.batch, name == "torch-compiled", c.threads)
    for name, run in peers.items():
        begin = time.perf_counter()
        run(), run()
        print(f"{name}: two first updates, with compilation, {time.perf_counter() - begin:.1f} s", file=sys.stderr)
    command = [c.qedgix, "bench", "learner", "--algorithm", c.algorithm, "--threads", str(c.threads), "--repeat", "3", "--json",
               "--set", f"training.batch={c.batch}", "--set", "training.memory=none"]
    seconds = {"qedgix": []} | {name: [] for name in peers}
    for _ in range(c.rounds):
        ours = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        seconds["qedgix"].append(ours["update_s"])
        for name, run in peers.items():
            begin = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - begin)
    print(f"update of {c.batch} episodes, {c.algorithm}, {c.threads} threads, {ours.get('vector_width', '')}")
    for name, all_seconds in seconds.items():
        ratio = statistics.median(a / b for a, b in zip(all_seconds, seconds["qedgix"]))
        print(f"{name:<16}{statistics.median(all_seconds):>9.4f} s{ratio:>8.1f}")


def check(algorithm):
    import jax_peer
    import model
    import torch_peer
    arguments = algorithm, model.initial(algorithm, 1), model.initial(algorithm, 2), model.random_batch(4)
    (loss, grads), (other_loss, other) = jax_peer.loss_and_gradient(*arguments), torch_peer.loss_and_gradient(*arguments)
    worst = max(float(abs(grads[k] - other[k].numpy()).max() / abs(grads[k]).max()) for k in grads)
    print(f"loss {loss:.6f} and {other_loss:.6f}; largest relative difference of a gradient {worst:.1e}")
    return 0 if worst < 1e-3 else 1


if __name__ == "__main__":
    sys.exit(main())
