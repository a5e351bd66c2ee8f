"""Runs a model, exported or not, on whole photos at a chosen scale."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from .net import STRIDE, UNet, WithSigmoid


class Runner:
    """`runner(image)` gives probabilities [C, H, W] for an RGB uint8 photo."""

    def __init__(self, model: Path, threads: int = 2):
        self.out_scale = 1
        if model.suffix == ".onnx":
            import onnxruntime as ort

            options = ort.SessionOptions()
            options.intra_op_num_threads = threads
            self.session = ort.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])
            self.meta = self.session.get_modelmeta().custom_metadata_map
            self.infer = lambda x: self.session.run(None, {"image": x})[0]
        else:
            import torch

            torch.set_num_threads(threads)
            state = torch.load(model, map_location="cpu", weights_only=True)
            net = UNet(tuple(state["widths"]))
            net.load_state_dict(state["mean"])
            net = WithSigmoid(net).eval()
            self.meta = {}

            def infer(x: np.ndarray) -> np.ndarray:
                with torch.inference_mode():
                    return net(torch.from_numpy(x)).numpy()

            self.infer = infer

    def __call__(self, image: np.ndarray) -> np.ndarray:
        h, w = image.shape[:2]
        ph, pw = -h % STRIDE, -w % STRIDE
        padded = cv2.copyMakeBorder(image, 0, ph, 0, pw, cv2.BORDER_REFLECT_101)
        x = padded.astype(np.float32).transpose(2, 0, 1)[None] / 255.0
        return self.infer(np.ascontiguousarray(x))[0][:, :h, :w]


def resample(image: np.ndarray, scale: float) -> np.ndarray:
    if abs(scale - 1) < 1e-6:
        return image
    h, w = image.shape[:2]
    size = (max(1, round(w * scale)), max(1, round(h * scale)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
