"""Runs a model of either kind, exported or not, on whole photos."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from .net import STRIDE


class Runner:
    """`runner(image)` gives what the network says of an RGB uint8 photo: the U-Net probabilities [C, H, W] of the photo's size,
    the instance network its `output0` [37, A] and `output1` [32, H/4, W/4]. `kind` is `unet` or `yolo`."""

    def __init__(self, model: Path, threads: int = 2, kind: str = "unet"):
        if model.suffix == ".onnx":
            import onnxruntime as ort

            options = ort.SessionOptions()
            options.intra_op_num_threads = threads
            self.session = ort.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])
            self.meta = self.session.get_modelmeta().custom_metadata_map
            self.kind = self.meta.get("heliomap.kind", kind)
            name = self.session.get_inputs()[0].name
            self.infer = lambda x: self.session.run(None, {name: x})
        else:
            import torch

            from .export import load

            torch.set_num_threads(threads)
            net, *_ = load(torch.load(model, map_location="cpu", weights_only=True), kind)
            self.meta, self.kind = {}, kind

            def infer(x: np.ndarray) -> list[np.ndarray]:
                with torch.inference_mode():
                    out = net(torch.from_numpy(x))
                return [t.numpy() for t in (out if isinstance(out, tuple) else (out,))]

            self.infer = infer

    def __call__(self, image: np.ndarray):
        h, w = image.shape[:2]
        ph, pw = -h % STRIDE, -w % STRIDE
        padded = cv2.copyMakeBorder(image, 0, ph, 0, pw, cv2.BORDER_REFLECT_101)
        x = padded.astype(np.float32).transpose(2, 0, 1)[None] / 255.0
        out = self.infer(np.ascontiguousarray(x))
        return out[0][0][:, :h, :w] if self.kind == "unet" else (out[0][0], out[1][0])


def resample(image: np.ndarray, scale: float) -> np.ndarray:
    if abs(scale - 1) < 1e-6:
        return image
    h, w = image.shape[:2]
    size = (max(1, round(w * scale)), max(1, round(h * scale)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
