"""A checkpoint to train on from an exported model: `python -m training.unfold --model models/unet.onnx --out runs/start.pt`.

The export folded each batch normalisation into its convolution. Here each convolution gets weights of unit norm, and the
normalisation after it the mean and variance measured on training samples, with scale and shift such that the function is
unchanged. `training.train --init` takes the result.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import onnx
import onnxruntime as ort
import torch
from torch import nn

from . import sources
from .dataset import Stream
from .net import WIDTHS, UNet, WithSigmoid

TOLERANCE = 2e-3


def pairs(net: nn.Module) -> list[tuple[nn.Conv2d, nn.BatchNorm2d | None]]:
    """Convolutions in order of definition, each with the normalisation that follows it."""
    found: list[tuple[nn.Conv2d, nn.BatchNorm2d | None]] = []
    for m in net.modules():
        if isinstance(m, nn.Conv2d):
            found.append((m, None))
        elif isinstance(m, nn.BatchNorm2d):
            found[-1] = (found[-1][0], m)
    return found


def execution_order(net: UNet) -> list[nn.Conv2d]:
    """Convolutions in the order in which an image passes them, that of the exported graph."""
    order: list[nn.Conv2d] = []
    hooks = [c.register_forward_hook(lambda m, *_: order.append(m)) for c, _ in pairs(net)]
    with torch.inference_mode():
        net.eval()(torch.zeros(1, 3, 32, 32))
    for h in hooks:
        h.remove()
    return order


def unfold(model: onnx.ModelProto, samples: torch.Tensor) -> UNet:
    """The network of an exported model, its normalisations set by `samples` [N, 3, H, W]."""
    values = {t.name: onnx.numpy_helper.to_array(t) for t in model.graph.initializer}
    convs = [n for n in model.graph.node if n.op_type == "Conv"]
    net = UNet(WIDTHS)
    norms = dict(pairs(net))
    order = execution_order(net)
    if len(order) != len(convs):
        raise SystemExit(f"{len(convs)} convolutions, but the network has {len(order)}: the model is another network's")
    with torch.no_grad():
        for conv, node in zip(order, convs):
            weight, bias = (torch.tensor(values[name]) for name in node.input[1:3])
            if weight.shape != conv.weight.shape:
                raise SystemExit(f"{node.name} is {tuple(weight.shape)}, not {tuple(conv.weight.shape)}")
            bn = norms[conv]
            if bn is None:
                conv.weight.copy_(weight)
                conv.bias.copy_(bias)
                continue
            norm = weight.flatten(1).norm(dim=1).clamp(min=1e-6)
            conv.weight.copy_(weight / norm[:, None, None, None])
            bn.weight.copy_(norm)
            bn.bias.copy_(bias)
            bn.running_mean.zero_()
            bn.running_var.fill_(1.0 - bn.eps)
        sums: dict[nn.Conv2d, list[torch.Tensor]] = {c: [] for c in order}
        hooks = [
            c.register_forward_hook(lambda m, _, y: sums[m].append(torch.stack([y.mean((0, 2, 3)), (y * y).mean((0, 2, 3))])))
            for c in order
        ]
        for batch in samples.split(8):
            net(batch)
        for h in hooks:
            h.remove()
        for conv in order:
            bn = norms[conv]
            if bn is None:
                continue
            mean, square = torch.stack(sums[conv]).mean(dim=0)
            var = (square - mean * mean).clamp(min=1e-8)
            bn.running_mean.copy_(mean)
            bn.running_var.copy_(var)
            bn.bias += bn.weight * mean
            bn.weight *= (var + bn.eps).sqrt()
    return net


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--model", type=Path, default=Path("models/unet.onnx"))
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--samples", type=int, default=96)
    p.add_argument("--size", type=int, default=256)
    a = p.parse_args()
    torch.manual_seed(0)
    stream = iter(Stream([(0.6, sources.renders("train")), (0.1, sources.real_frames(test=False))], a.size, seed=1))
    samples = torch.stack([next(stream)[0] for _ in range(a.samples)])
    model = onnx.load(str(a.model))
    net = unfold(model, samples).eval()
    session = ort.InferenceSession(str(a.model), providers=["CPUExecutionProvider"])
    x = samples[:4]
    with torch.inference_mode():
        worst = float(np.abs(WithSigmoid(net)(x).numpy() - session.run(None, {"image": x.numpy()})[0]).max())
    print(f"largest difference to the exported model {worst:.1e}")
    if worst > TOLERANCE:
        raise SystemExit("the unfolded network is not the exported one")
    a.out.parent.mkdir(parents=True, exist_ok=True)
    steps = next((int(e.value) for e in model.metadata_props if e.key == "heliomap.steps"), 0)
    torch.save({"net": net.state_dict(), "mean": net.state_dict(), "widths": WIDTHS, "step": steps}, a.out)


if __name__ == "__main__":
    cv2.setNumThreads(1)
    main()
