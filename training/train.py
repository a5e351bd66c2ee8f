"""Trains both networks: `python -m training.train --out DIR [--minutes N]`. Run it again to resume."""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # numpy draws in the loader: its threads would fight torch's

import cv2
import torch
from torch.utils.data import DataLoader

from . import instances, loss, sources, targets
from .dataset import Stream
from .net import WIDTHS, Instances, Joint, UNet

INSTANCE_SHARE = 0.3  # weight of the instance network's loss where both are trained on one trunk


def joint_targets(quads, ignore, size):
    return *targets.make_targets(quads, ignore, size), *instances.make_targets(quads, ignore, size)


def joint_loss(raw, target, weight, cells, ids):
    return loss.loss_fn(raw[0], target, weight) + INSTANCE_SHARE * instances.loss_fn(raw[1:], cells, ids)


# What is trained: the network, its targets, its loss.
KINDS = {
    "unet": (UNet, targets.make_targets, loss.loss_fn),
    "yolo": (Instances, instances.make_targets, instances.loss_fn),
    "joint": (Joint, joint_targets, joint_loss),
}


def arguments() -> argparse.Namespace:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--kind", choices=KINDS, default="joint")
    p.add_argument("--out", type=Path, default=Path("runs/both"), help="folder of checkpoints and the log")
    p.add_argument("--steps", type=int, default=5000, help="length of the learning-rate schedule")
    p.add_argument(
        "--minutes", type=float, default=0, help="end the schedule after so many minutes, if the steps do not end it first"
    )
    p.add_argument("--batch", type=int, default=6)
    p.add_argument("--size", type=int, default=256, help="side of a crop in pixels")
    p.add_argument("--lr", type=float, default=2e-3)
    p.add_argument("--seed", type=int, default=7)
    p.add_argument("--threads", type=int, default=2)
    p.add_argument("--workers", type=int, default=1)
    p.add_argument("--renders", type=float, default=0.30, help="share of crops of rendered plants")
    p.add_argument("--real", type=float, default=0.11, help="share of crops of hand-labelled real frames and orthophotos")
    p.add_argument("--self", dest="own", type=float, default=0.0, help="share of crops of self-labelled frames")
    p.add_argument("--self-labels", help="labels file of the self-labelled frames (training.bootstrap)")
    p.add_argument("--init", type=Path, help="start from the averaged weights of this checkpoint, of either kind: what both share")
    p.add_argument("--save-every", type=float, default=120, help="seconds between checkpoints")
    return p.parse_args()


def schedule(step: int, done: float) -> float:
    """Share of the learning rate at a step when `done` (0..1) of the training is over."""
    warm = min(1.0, (step + 1) / 100)
    return warm * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(1.0, done))))


class Run:
    """The network, the running average of its weights (what is exported), its optimiser, and how far training is."""

    def __init__(self, a: argparse.Namespace, device: torch.device):
        self.args, self.path = a, a.out / "checkpoint.pt"
        net_of = KINDS[a.kind][0]
        self.net = net_of(WIDTHS).to(device, memory_format=torch.channels_last)
        self.mean = net_of(WIDTHS).to(device)
        self.opt = torch.optim.AdamW(self.net.parameters(), lr=a.lr, weight_decay=1e-3)
        self.step, self.before, self.begun = 0, 0.0, time.time()  # steps, seconds of earlier runs, start of this one
        if self.path.exists():
            state = torch.load(self.path, map_location=device, weights_only=True)
            self.net.load_state_dict(state["net"])
            self.mean.load_state_dict(state["mean"])
            self.opt.load_state_dict(state["opt"])
            self.step, self.before = state["step"], state.get("seconds", 0.0)
            print(f"resumed at step {self.step}", flush=True)
            return
        if a.init:
            state = torch.load(a.init, map_location=device, weights_only=True)
            self.net.load_state_dict(state["mean"], strict=False)
        self.mean.load_state_dict(self.net.state_dict())

    @property
    def seconds(self) -> float:
        return self.before + time.time() - self.begun

    def save(self) -> None:
        state = {"kind": self.args.kind, "net": self.net.state_dict(), "mean": self.mean.state_dict(), "opt": self.opt.state_dict()}
        state |= {"step": self.step, "widths": WIDTHS, "seconds": self.seconds}
        torch.save(state, self.path.with_suffix(".tmp"))
        os.replace(self.path.with_suffix(".tmp"), self.path)

    def learn(self, value: torch.Tensor) -> None:
        """One step down the loss."""
        self.opt.zero_grad(set_to_none=True)
        value.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), 2.0)
        self.opt.step()
        self.step += 1
        with torch.no_grad():
            k = min(0.995, self.step / (self.step + 10))
            for m, n in zip(self.mean.state_dict().values(), self.net.state_dict().values()):
                if m.dtype.is_floating_point:
                    m.lerp_(n, 1 - k)
                else:
                    m.copy_(n)


def mixture(a: argparse.Namespace) -> list[tuple[float, list[sources.Photo]]]:
    """Photos with their shares; the rest is drawn."""
    mix = [
        (a.renders, sources.renders("train")),
        (a.real, sources.real_frames(test=False) + sources.orthophotos(test=False)),
        (a.own, sources.self_labelled(a.self_labels)),
    ]
    print("photos:", [len(p) for _, p in mix], flush=True)
    return mix


def main() -> None:
    a = arguments()
    a.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(a.seed)
    torch.set_num_threads(a.threads)
    cv2.setNumThreads(0)  # OpenCV's thread pool does not survive the fork of the loader's processes
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    _, make_targets, loss_fn = KINDS[a.kind]
    run = Run(a, device)
    stop = False

    def on_signal(*_: object) -> None:
        nonlocal stop
        stop = True

    signal.signal(signal.SIGTERM, on_signal)
    signal.signal(signal.SIGINT, on_signal)
    stream = Stream(mixture(a), a.size, a.seed, start=run.step * a.batch, targets=make_targets)
    loader = iter(DataLoader(stream, a.batch, num_workers=a.workers, prefetch_factor=6 if a.workers else None))
    run.net.train()
    run.begun = saved = time.time()
    average, first = 0.0, run.step
    while run.step < a.steps and not stop:
        over = run.seconds / (a.minutes * 60) if a.minutes else 0.0
        if over >= 1.0:
            break
        for g in run.opt.param_groups:
            g["lr"] = a.lr * schedule(run.step, max(run.step / a.steps, over))
        x, *wanted = (t.to(device) for t in next(loader))
        x = x.contiguous(memory_format=torch.channels_last)
        with torch.autocast(device.type, torch.bfloat16):
            raw = run.net(x)
        value = loss_fn(raw, *wanted)
        run.learn(value)
        average = value.item() if average == 0 else 0.98 * average + 0.02 * value.item()
        now = time.time()
        if run.step % 50 == 0:
            pace = (now - run.begun) / (run.step - first)
            print(f"step {run.step} loss {average:.4f} {pace:.2f} s/step", flush=True)
            with open(a.out / "log.jsonl", "a") as f:
                f.write(json.dumps({"step": run.step, "loss": round(average, 5), "s_per_step": round(pace, 3)}) + "\n")
        if now - saved > a.save_every:
            run.save()
            saved = now
    run.save()
    print(f"stopped at step {run.step}", flush=True)


if __name__ == "__main__":
    main()
