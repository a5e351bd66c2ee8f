"""The network: a small residual U-Net built for CPU inference.

Everything heavy runs at half resolution or below. The stem is a strided convolution, levels halve with
strided convolutions, the way up is a 1x1 convolution followed by a pixel shuffle (cheap in ONNX Runtime),
skips are added instead of concatenated. Batch normalisation folds into the convolutions at export.
"""

from __future__ import annotations

import torch
from torch import nn

CHANNELS = ("module", "core")
WIDTHS = (16, 40, 72, 96, 128)
STRIDE = 32


def conv(cin: int, cout: int, k: int = 3, stride: int = 1, act: bool = True) -> nn.Sequential:
    layers: list[nn.Module] = [
        nn.Conv2d(cin, cout, k, stride, (k - 1) // 2, bias=False),
        nn.BatchNorm2d(cout),
    ]
    if act:
        layers.append(nn.ReLU(inplace=True))
    return nn.Sequential(*layers)


class Residual(nn.Module):
    def __init__(self, c: int):
        super().__init__()
        self.a = conv(c, c)
        self.b = conv(c, c, act=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.relu(x + self.b(self.a(x)))


class Up(nn.Module):
    """1x1 convolution to 4 c channels, then a pixel shuffle to twice the size."""

    def __init__(self, cin: int, cout: int):
        super().__init__()
        self.proj = conv(cin, 4 * cout, 1, act=False)
        self.shuffle = nn.PixelShuffle(2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.shuffle(self.proj(x))


class UNet(nn.Module):
    """`forward` gives logits [N, C, H, W] for an RGB image in 0..1 [N, 3, H, W], H and W multiples of 32."""

    def __init__(self, widths: tuple[int, ...] = WIDTHS, out: int = len(CHANNELS)):
        super().__init__()
        w = widths
        self.stem = nn.Sequential(
            nn.Conv2d(3, w[0], 4, 2, 1, bias=False), nn.BatchNorm2d(w[0]), nn.ReLU(inplace=True), conv(w[0], w[0])
        )
        self.down = nn.ModuleList()
        for i in range(1, len(w)):
            self.down.append(nn.Sequential(conv(w[i - 1], w[i], 3, 2), Residual(w[i])))
        self.up = nn.ModuleList(Up(w[i], w[i - 1]) for i in range(len(w) - 1, 0, -1))
        self.dec = nn.ModuleList(Residual(w[i - 1]) for i in range(len(w) - 1, 0, -1))
        self.head = nn.Conv2d(w[0], 4 * out, 3, 1, 1)
        self.shuffle = nn.PixelShuffle(2)
        nn.init.constant_(self.head.bias, -1.0)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = self.stem(x * 4.0 - 2.0)
        skips = []
        for d in self.down:
            skips.append(x)
            x = d(x)
        for up, dec, s in zip(self.up, self.dec, reversed(skips)):
            x = dec(torch.relu(up(x) + s))
        return self.shuffle(self.head(x))


class WithSigmoid(nn.Module):
    """What is exported: probabilities instead of logits."""

    def __init__(self, net: UNet):
        super().__init__()
        self.net = net

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(self.net(image))
