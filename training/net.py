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


def levels(net: nn.Module, x: torch.Tensor) -> list[torch.Tensor]:
    """Features on the way up, coarsest first."""
    x = net.stem(x * 4.0 - 2.0)
    skips = []
    for d in net.down:
        skips.append(x)
        x = d(x)
    out = []
    for up, dec, s in zip(net.up, net.dec, reversed(skips)):
        x = dec(torch.relu(up(x) + s))
        out.append(x)
    return out


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
        return self.shuffle(self.head(levels(self, x)[-1]))


class Instances(nn.Module):
    """A one-class instance network with the outputs of YOLOv8-seg, on the U-Net's encoder and the first of its decoder.

    One anchor per cell of 8 x 8 pixels. `forward` gives raw maps: `head` [N, 11 + P, H/8, W/8] and learned prototypes
    [N, P, H/4, W/4]; `decode` turns them into what is exported. Convolutions cannot tell one module of a lattice from
    the next by learned prototypes alone, so six more prototypes are fixed: 1, x, y, x^2, x y, y^2. Each anchor's head says
    a quadratic form about its own centre, whose coefficients on these six follow by expansion.
    """

    CELL = 8
    LEARNED = 26
    FIXED = 6
    FORM_SCALE = 64.0  # pixels: the unit of the fixed prototypes' coordinates

    def __init__(self, widths: tuple[int, ...] = WIDTHS):
        super().__init__()
        base = UNet(widths)
        self.stem, self.down = base.stem, base.down
        self.up, self.dec = base.up[:-1], base.dec[:-1]
        self.add_heads(widths)

    def add_heads(self, w: tuple[int, ...]) -> None:
        self.anchor = nn.Sequential(conv(w[2], w[2]), conv(w[2], w[2]))
        # score; centre x, y; log w, h; quadratic form (3), linear (2), constant; coefficients of the learned prototypes
        self.predict = nn.Conv2d(w[2], 11 + self.LEARNED, 1)
        self.proto = nn.Sequential(conv(w[1], w[1]), nn.Conv2d(w[1], self.LEARNED, 1))
        nn.init.normal_(self.predict.weight, std=0.01)
        nn.init.zeros_(self.predict.bias)
        with torch.no_grad():
            self.predict.bias[0] = -3.0
            self.predict.bias[3:5] = 1.3
            self.predict.bias[10] = 2.0

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        up = levels(self, x)
        return self.predict(self.anchor(up[-2])), self.proto(up[-1])

    @classmethod
    def decode(cls, head: torch.Tensor, proto: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Raw maps to `output0` [N, 37, A] and `output1` [N, 32, H/4, W/4], in float32.

        Coordinates of the fixed prototypes are input pixels (corners at whole numbers) from the image's middle, in
        units of FORM_SCALE.
        """
        n, _, h, w = head.shape
        ys = (torch.arange(h, device=head.device, dtype=torch.float32) + 0.5) * cls.CELL
        xs = (torch.arange(w, device=head.device, dtype=torch.float32) + 0.5) * cls.CELL
        cy, cx = ys[None, :, None], xs[None, None, :]
        head, proto = head.float(), proto.float()
        bx, by = cx + head[:, 1] * cls.CELL, cy + head[:, 2] * cls.CELL
        bw, bh = torch.exp(head[:, 3].clamp(-2, 4)) * cls.CELL, torch.exp(head[:, 4].clamp(-2, 4)) * cls.CELL
        # -|L p|^2 with p from the predicted centre in units of 8 pixels, L lower triangular; plus linear and constant.
        k = cls.FORM_SCALE / cls.CELL
        a, b, c = torch.exp(head[:, 5].clamp(-4, 3)), head[:, 6], torch.exp(head[:, 7].clamp(-4, 3))
        qxx, qxy, qyy = -(a * a + b * b) * k * k, -2 * b * c * k * k, -c * c * k * k
        lx, ly, l0 = head[:, 8] * k, head[:, 9] * k, head[:, 10]
        ox, oy = (bx - w * cls.CELL / 2) / cls.FORM_SCALE, (by - h * cls.CELL / 2) / cls.FORM_SCALE
        fixed = [
            l0 - lx * ox - ly * oy + qxx * ox * ox + qxy * ox * oy + qyy * oy * oy,
            lx - 2 * qxx * ox - qxy * oy,
            ly - 2 * qyy * oy - qxy * ox,
            qxx,
            qxy,
            qyy,
        ]
        out0 = torch.cat([torch.stack([bx, by, bw, bh, torch.sigmoid(head[:, 0])], 1), head[:, 11:], torch.stack(fixed, 1)], 1)
        py = ((torch.arange(2 * h, device=head.device, dtype=torch.float32) + 0.5) * 4 - h * cls.CELL / 2) / cls.FORM_SCALE
        px = ((torch.arange(2 * w, device=head.device, dtype=torch.float32) + 0.5) * 4 - w * cls.CELL / 2) / cls.FORM_SCALE
        gy, gx = torch.meshgrid(py, px, indexing="ij")
        grid = torch.stack([torch.ones_like(gx), gx, gy, gx * gx, gx * gy, gy * gy])
        return out0.flatten(2), torch.cat([proto, grid[None].expand(n, -1, -1, -1)], 1)


class Joint(UNet):
    """Both networks on one trunk, for training: two cores have not the time for two trunks. Either is exported alone."""

    LEARNED = Instances.LEARNED

    def __init__(self, widths: tuple[int, ...] = WIDTHS):
        super().__init__(widths)
        Instances.add_heads(self, widths)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        up = levels(self, x)
        return self.shuffle(self.head(up[-1])), self.predict(self.anchor(up[-3])), self.proto(up[-2])


class Decoded(nn.Module):
    """What is exported of `Instances`."""

    def __init__(self, net: Instances):
        super().__init__()
        self.net = net

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.net.decode(*self.net(images))


class WithSigmoid(nn.Module):
    """What is exported: probabilities instead of logits."""

    def __init__(self, net: UNet):
        super().__init__()
        self.net = net

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(self.net(image))
