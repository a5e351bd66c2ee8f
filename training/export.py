"""Writes the ONNX model: `python -m training.export --checkpoint runs/unet/checkpoint.pt --out models/unet.onnx`.

Checks that ONNX Runtime and PyTorch agree on several sizes, and writes what the service must know as metadata.
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

from .net import CHANNELS, UNet, WithSigmoid
from .targets import CORE_SHRINK, GSD, GSD_RANGE

TOLERANCE = 2e-3


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--checkpoint", type=Path, default=Path("runs/unet/checkpoint.pt"))
    p.add_argument("--out", type=Path, default=Path("models/unet.onnx"))
    p.add_argument("--version", default="0.1.0")
    p.add_argument("--self-frames", type=int, default=0, help="self-labelled frames it was trained on (for the card)")
    a = p.parse_args()
    state = torch.load(a.checkpoint, map_location="cpu", weights_only=True)
    net = UNet(tuple(state["widths"]))
    net.load_state_dict(state["mean"])
    model = WithSigmoid(net).eval()
    a.out.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            model,
            (torch.rand(1, 3, 64, 96),),
            str(a.out),
            input_names=["image"],
            output_names=["masks"],
            dynamic_axes={"image": {0: "n", 2: "h", 3: "w"}, "masks": {0: "n", 2: "h", 3: "w"}},
            opset_version=17,
            dynamo=False,
        )
    onnx_model = onnx.load(str(a.out))
    digest = hashlib.sha256(b"".join(t.raw_data for t in onnx_model.graph.initializer)).hexdigest()[:12]
    onnx.helper.set_model_props(
        onnx_model,
        {
            "heliomap.kind": "unet",
            "heliomap.channels": ",".join(CHANNELS),
            "heliomap.core_shrink": str(CORE_SHRINK),
            "heliomap.gsd_m": str(GSD),
            "heliomap.gsd_range_m": ",".join(str(v) for v in GSD_RANGE),
            "heliomap.version": f"{a.version}+{digest}",
            "heliomap.steps": str(state["step"]),
            "heliomap.self_frames": str(a.self_frames),
        },
    )
    onnx.checker.check_model(onnx_model)
    onnx.save(onnx_model, str(a.out))

    session = ort.InferenceSession(str(a.out), providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(1)
    worst = 0.0
    for n, h, w in ((1, 32, 32), (1, 256, 256), (2, 320, 192), (1, 928, 1376)):
        x = rng.random((n, 3, h, w), dtype=np.float32)
        y = session.run(None, {"image": x})[0]
        with torch.inference_mode():
            t = model(torch.from_numpy(x)).numpy()
        assert y.shape == (n, len(CHANNELS), h, w), y.shape
        assert 0.0 <= y.min() and y.max() <= 1.0
        worst = max(worst, float(np.abs(y - t).max()))
    print(f"{a.out}: {a.out.stat().st_size / 1e6:.2f} MB, largest difference to PyTorch {worst:.1e}")
    if worst > TOLERANCE:
        raise SystemExit("ONNX Runtime and PyTorch disagree")


if __name__ == "__main__":
    main()
