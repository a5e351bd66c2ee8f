"""Crops with random geometry, and what cameras, weather and codecs do to pixels."""

from __future__ import annotations

import cv2
import numpy as np

from .sources import Photo

Rng = np.random.Generator


def transform(points: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Applies a homography; points beyond its horizon become NaN."""
    shape = points.shape
    p = points.reshape(-1, 2)
    q = np.concatenate([p, np.ones((len(p), 1))], axis=1) @ h.T
    return (q[:, :2] / np.where(q[:, 2:] > 0.15, q[:, 2:], np.nan)).reshape(shape)


def crop(photo: Photo, size: int, rng: Rng, short_side: tuple[float, float]) -> tuple[np.ndarray, np.ndarray, list]:
    """A size x size crop in which a module's short side measures `short_side` pixels, turned, sheared, tilted."""
    h, w = photo.image.shape[:2]
    want = np.exp(rng.uniform(np.log(short_side[0]), np.log(short_side[1])))
    scale = float(np.clip(want / photo.module_px, 0.16, 1.5))
    if rng.random() < 0.65 and len(photo.quads):
        center = photo.quads[rng.integers(len(photo.quads))].mean(axis=0) + rng.normal(0, 0.2 * size / scale, 2)
    else:
        center = rng.uniform((0, 0), (w, h))
    # Stay inside the photo where its extent allows it.
    half = 0.5 * size / scale
    for i, extent in enumerate((w, h)):
        lo, hi = 0.75 * half, extent - 0.75 * half
        center[i] = np.clip(center[i], lo, hi) if lo < hi else extent / 2
    angle = rng.uniform(0, 2 * np.pi) if rng.random() < 0.7 else rng.normal(0, 0.1) + np.pi / 2 * rng.integers(4)
    ca, sa = np.cos(angle), np.sin(angle)
    a = np.array([[ca, -sa], [sa, ca]]) * scale
    a = a @ np.diag(np.exp(rng.normal(0, 0.08, 2)))
    a = a @ np.array([[1, rng.normal(0, 0.05)], [0, 1]])
    if rng.random() < 0.5:
        a = a @ np.diag([-1.0, 1.0])
    m = np.eye(3)
    m[:2, :2] = a
    m[:2, 2] = size / 2 - a @ center
    persp = np.eye(3)
    persp[2, :2] = rng.normal(0, 0.12, 2) / size
    shift = np.eye(3)
    shift[:2, 2] = -size / 2
    back = np.eye(3)
    back[:2, 2] = size / 2
    m = back @ persp @ shift @ m
    k = int(np.clip(np.ceil(0.8 / scale), 1, 4))
    fine = np.diag([k, k, 1.0])
    fine[:2, 2] = (k - 1) / 2
    border = cv2.BORDER_REFLECT_101 if rng.random() < 0.5 else cv2.BORDER_CONSTANT
    fill = tuple(int(v) for v in rng.integers(0, 256, 3))
    image = cv2.warpPerspective(
        photo.image, fine @ m, (size * k, size * k), flags=cv2.INTER_LINEAR, borderMode=border, borderValue=fill
    )
    if k > 1:
        image = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)
    quads = transform(photo.quads, m)
    ignore = [p for p in (transform(p, m) for p in photo.ignore) if np.isfinite(p).all()]
    # Outside of the photo nothing is known.
    frame = np.array([[-0.5, -0.5], [w - 0.5, -0.5], [w - 0.5, h - 0.5], [-0.5, h - 0.5]])
    inside = transform(frame, m)
    middle = transform(np.array([[w / 2, h / 2]]), m)[0]
    for i in range(4):
        e0, e1 = inside[i], inside[(i + 1) % 4]
        d = e1 - e0
        n = np.array([d[1], -d[0]])
        if np.dot(n, middle - e0) > 0:
            n = -n
        n = n / (np.linalg.norm(n) + 1e-9) * 4 * size
        d = d / (np.linalg.norm(d) + 1e-9) * 4 * size
        if not np.isfinite(e0 + e1).all():
            continue
        strip = np.array([e0 - d, e1 + d, e1 + d + n, e0 - d + n])
        if strip[:, 0].max() > 0 and strip[:, 1].max() > 0 and (strip.min(axis=0) < size).all():
            ignore.append(np.clip(strip, -20 * size, 20 * size))
    return image, quads, ignore


def noise_field(rng: Rng, size: int, cell: float) -> np.ndarray:
    """Smooth noise, about normal, `cell` pixels from bump to bump."""
    n = max(2, int(np.ceil(size / cell)) + 2)
    g = rng.standard_normal((n, n)).astype(np.float32)
    return cv2.resize(g, (size, size), interpolation=cv2.INTER_CUBIC)


def photometric(image: np.ndarray, rng: Rng, strength: float = 1.0) -> np.ndarray:
    """Colour, light, glare, shadow, haze, blur, noise, JPEG."""
    size = image.shape[0]
    x = image.astype(np.float32) / 255.0
    if rng.random() < 0.15 * strength:
        x = blob(x, rng)
    if rng.random() < 0.2 * strength:  # a soft shadow of a cloud, a tree or the next bench
        f = noise_field(rng, size, rng.uniform(30, 200)) + rng.normal(0, 0.7)
        x = x * (1 - rng.uniform(0.2, 0.6) / (1 + np.exp(-f * rng.uniform(2, 12))))[..., None]
    if rng.random() < 0.15 * strength:  # haze
        a = rng.uniform(0, 0.35)
        x = x * (1 - a) + a * (rng.uniform(0.5, 1.0) + rng.normal(0, 0.04, 3).astype(np.float32))
    if rng.random() < 0.8:
        x = x * np.exp(rng.normal(0, 0.09 * strength, 3)).astype(np.float32)
        gray = x.mean(axis=2, keepdims=True)
        x = gray + (x - gray) * np.float32(rng.uniform(0.4, 1.5) if strength > 0.5 else rng.uniform(0.8, 1.2))
        x = np.clip(x, 0, None) ** np.float32(np.exp(rng.normal(0, 0.22 * strength)))
        x = (x - 0.5) * np.float32(np.exp(rng.normal(0, 0.15))) + 0.5 + np.float32(rng.normal(0, 0.06))
    if rng.random() < 0.12:  # a dark, flat exposure
        x = x * np.float32(rng.uniform(0.25, 0.7)) + np.float32(rng.uniform(0.0, 0.12))
    x = blur(x, rng)
    if rng.random() < 0.25:  # sharpening halos of drone cameras
        b = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.6, 1.5))
        x = x + (x - b) * np.float32(rng.uniform(0.2, 1.2))
    if rng.random() < 0.5:
        n = rng.standard_normal(x.shape[:2] + ((3,) if rng.random() < 0.5 else (1,)), dtype=np.float32)
        if rng.random() < 0.4:
            n = cv2.GaussianBlur(n, (0, 0), 0.7).reshape(n.shape) * 2
        x = x + n * np.float32(rng.uniform(0, 0.045))
    out = np.clip(x * 255 + 0.5, 0, 255).astype(np.uint8)
    if rng.random() < 0.5:
        q = int(rng.integers(45, 96))
        _, buf = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, q])
        out = cv2.imdecode(buf, cv2.IMREAD_COLOR)
    if rng.random() < 0.03:
        out = np.repeat(out.mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8)
    return out


def blur(x: np.ndarray, rng: Rng) -> np.ndarray:
    """Out of focus, or moved while the shutter was open; mostly neither."""
    r = rng.random()
    if r < 0.35:
        return cv2.GaussianBlur(x, (0, 0), rng.uniform(0.3, 1.3) if rng.random() < 0.75 else rng.uniform(1.3, 2.3))
    if r < 0.52:
        length = rng.uniform(2, 5) if rng.random() < 0.6 else rng.uniform(5, 9)
        k = np.zeros((11, 11), np.float32)
        a = rng.uniform(0, np.pi)
        tip = np.array([np.cos(a), np.sin(a)]) * length / 2
        ends = (np.array([5 - tip, 5 + tip]) * 16).round().astype(int).tolist()
        cv2.line(k, ends[0], ends[1], 1.0, 1, cv2.LINE_8, 4)
        k += k[::-1, ::-1]  # about the middle: what is blurred does not move
        return cv2.filter2D(x, -1, k / k.sum())
    return x


def blob(x: np.ndarray, rng: Rng) -> np.ndarray:
    """A glare spot that drives the pixels towards white."""
    size = x.shape[0]
    yy, xx = np.mgrid[:size, :size].astype(np.float32)
    c = rng.uniform(0, size, 2)
    a = rng.uniform(0, np.pi)
    r = rng.uniform(12, 60) * np.array([1, rng.uniform(0.4, 1)])
    u = ((xx - c[0]) * np.cos(a) + (yy - c[1]) * np.sin(a)) / r[0]
    v = (-(xx - c[0]) * np.sin(a) + (yy - c[1]) * np.cos(a)) / r[1]
    g = np.exp(-0.5 * (u * u + v * v)) * np.float32(rng.uniform(0.3, 2.5))
    return x + g[..., None] * np.array([1, rng.uniform(0.93, 1), rng.uniform(0.8, 1)], np.float32)
