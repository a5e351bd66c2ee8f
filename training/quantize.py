"""An 8-bit copy of a model: `python -m training.quantize --model models/unet.onnx --out models/unet-int8.onnx`.

Static quantisation of ONNX Runtime, calibrated on crops of the training photos. The stem, the heads, what surrounds them, and
the arithmetic of boxes and masks stay in float32. Weights take 7 bits, for processors without VNNI add pairs of products in 16 bits.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import onnx
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

from . import sources
from .augment import crop


TRUNK = "/net/"  # names of what is inside the network, not of what turns its maps into boxes
HEADS = ("/head/Conv", "/predict/Conv", "/proto/proto.1/Conv")


class Crops(CalibrationDataReader):
    def __init__(self, name: str, count: int, seed: int = 0):
        photos = [p for f in sources.render_folders("train")[::3] for p in sources.load_render(f)[:1]]
        photos += sources.real_frames(test=False)
        rng = np.random.default_rng(seed)
        crops = (crop(photos[i % len(photos)], 320, rng, (12.0, 36.0))[0] for i in range(count))
        self.inputs = ({name: np.ascontiguousarray(c.astype(np.float32).transpose(2, 0, 1)[None]) / 255.0} for c in crops)

    def get_next(self):
        return next(self.inputs, None)


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--model", type=Path, default=Path("models/unet.onnx"))
    p.add_argument("--out", type=Path, default=Path("models/unet-int8.onnx"))
    p.add_argument("--crops", type=int, default=40)
    a = p.parse_args()
    cv2.setNumThreads(0)
    model = onnx.load(str(a.model))
    nodes = model.graph.node
    keep = [next(n.name for n in nodes if n.op_type == "Conv")]
    keep += [n.name for n in nodes if n.op_type in ("Mul", "Sub", "Sigmoid") or n.name.endswith(HEADS) or not n.name.startswith(TRUNK)]
    quantize_static(
        str(a.model),
        str(a.out),
        Crops(model.graph.input[0].name, a.crops),
        quant_format=QuantFormat.QDQ,
        per_channel=True,
        reduce_range=True,
        activation_type=QuantType.QUInt8,
        weight_type=QuantType.QInt8,
        nodes_to_exclude=keep,
    )
    small = onnx.load(str(a.out))
    props = {e.key: e.value for e in model.metadata_props}
    props["heliomap.version"] = props.get("heliomap.version", "?") + ".int8"
    del small.metadata_props[:]
    onnx.helper.set_model_props(small, props)
    onnx.checker.check_model(small)
    onnx.save(small, str(a.out))
    print(f"{a.out}: {a.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
