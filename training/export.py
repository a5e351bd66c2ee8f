"""Writes the ONNX model: `python -m training.export --checkpoint runs/both/checkpoint.pt --kind unet --out models/unet.onnx`.

Checks that ONNX Runtime and PyTorch agree on several sizes, and writes what the
service must know as metadata.
"""

from __future__ import annotations

import argparse
import hashlib
import warnings
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import torch
from torch import nn

from .net import CHANNELS, Decoded, Instances, UNet, WithSigmoid
from .targets import CORE_SHRINK, GSD, GSD_RANGE

TOLERANCE = 2e-3
SIZES = ((1, 32, 32), (1, 256, 256), (2, 320, 192), (1, 928, 1376))


def take(net: nn.Module, weights: dict) -> None:
    """Loads the network's own weights out of its checkpoint or that of both."""
    net.load_state_dict({k: weights[k] for k in net.state_dict()})


def load(state: dict, kind: str) -> tuple[nn.Module, str, dict[str, list[str]], dict[str, str]]:
    """The network of a checkpoint as it is exported: with its input, its outputs with their axes, its metadata."""
    widths = tuple(state["widths"])
    if kind == "unet":
        net = UNet(widths)
        take(net, state["mean"])
        meta = {"heliomap.kind": "unet", "heliomap.channels": ",".join(CHANNELS), "heliomap.core_shrink": str(CORE_SHRINK)}
        return WithSigmoid(net).eval(), "image", {"masks": ["n", "", "h", "w"]}, meta
    net = Instances(widths)
    take(net, state["mean"])
    meta = {
        "heliomap.kind": "yolo",
        "heliomap.classes": "module",
        "heliomap.strides": str(Instances.CELL),
        "heliomap.nms": "mask",
        "task": "segment",
        "stride": "32",
        "names": "{0: 'module'}",
    }
    return Decoded(net).eval(), "images", {"output0": ["n", "", "anchors"], "output1": ["n", "", "h4", "w4"]}, meta


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--checkpoint", type=Path, default=Path("runs/both/checkpoint.pt"))
    p.add_argument("--kind", choices=("unet", "yolo"), default="unet")
    p.add_argument("--out", type=Path, default=Path("models/unet.onnx"))
    p.add_argument("--version", default="0.2.0")
    p.add_argument("--self-frames", type=int, default=0, help="self-labelled frames it was trained on (for the card)")
    p.add_argument("--steps-before", type=int, default=0, help="steps of the weights that training started from (for the card)")
    a = p.parse_args()
    state = torch.load(a.checkpoint, map_location="cpu", weights_only=True)
    model, name, outputs, meta = load(state, a.kind)
    a.out.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            model,
            (torch.rand(1, 3, 64, 96),),
            str(a.out),
            input_names=[name],
            output_names=list(outputs),
            dynamic_axes={name: {0: "n", 2: "h", 3: "w"}} | {o: {i: x for i, x in enumerate(axes) if x} for o, axes in outputs.items()},
            opset_version=17,
            dynamo=False,
        )
    onnx_model = onnx.load(str(a.out))
    digest = hashlib.sha256(b"".join(t.raw_data for t in onnx_model.graph.initializer)).hexdigest()[:12]
    meta |= {
        "heliomap.gsd_m": str(GSD),
        "heliomap.gsd_range_m": ",".join(str(v) for v in GSD_RANGE),
        "heliomap.version": f"{a.version}+{digest}",
        "heliomap.steps": str(a.steps_before + state["step"]),
        "heliomap.self_frames": str(a.self_frames),
    }
    onnx.helper.set_model_props(onnx_model, meta)
    onnx.checker.check_model(onnx_model)
    onnx.save(onnx_model, str(a.out))

    session = ort.InferenceSession(str(a.out), providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(1)
    worst = 0.0
    for n, h, w in SIZES:
        x = rng.random((n, 3, h, w), dtype=np.float32)
        with torch.inference_mode():
            theirs = model(torch.from_numpy(x))
        for y, t in zip(session.run(None, {name: x}), theirs if isinstance(theirs, tuple) else (theirs,)):
            t = t.numpy()
            assert y.shape == t.shape and np.isfinite(y).all(), (y.shape, t.shape)
            worst = max(worst, float((np.abs(y - t) / np.maximum(1.0, np.abs(t))).max()))
    print(f"{a.out}: {a.out.stat().st_size / 1e6:.2f} MB, largest difference to PyTorch {worst:.1e}")
    if worst > TOLERANCE:
        raise SystemExit("ONNX Runtime and PyTorch disagree")


if __name__ == "__main__":
    main()
