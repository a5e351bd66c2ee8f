"""The camera, and how things are painted on the picture."""

from __future__ import annotations

import cv2
import numpy as np

from ..augment import Rng
from .patterns import rgb

UP = 2  # supersampling of the canvas
FAR = 1 << 24  # bound of fixed-point coordinates


class Camera:
    """World (x east, y north, z up, metres) to pixels of a canvas; looks about downwards at the origin."""

    def __init__(self, rng: Rng, size: int, gsd: float, max_tilt: float):
        f = rng.uniform(2.0, 5.0) * size
        tilt = np.deg2rad(min(abs(rng.normal(0, max_tilt / 2)), max_tilt))
        toward, roll = rng.uniform(0, 2 * np.pi, 2)
        forward = np.array([np.sin(tilt) * np.cos(toward), np.sin(tilt) * np.sin(toward), -np.cos(tilt)])
        self.center = -forward * gsd * f
        x = np.array([np.cos(roll), np.sin(roll), 0.0])
        x -= forward * (x @ forward)
        x /= np.linalg.norm(x)
        self.r = np.stack([x, np.cross(forward, x), forward])
        self.f, self.size = f, size

    def __call__(self, p: np.ndarray) -> np.ndarray:
        q = (np.asarray(p, float) - self.center) @ self.r.T
        z = np.maximum(q[..., 2:], 0.1)
        return self.f * q[..., :2] / z + self.size / 2 - 0.5


def poly_mask(n: int, quads, blur: float = 0.0) -> np.ndarray:
    m = np.zeros((n, n), np.uint8)
    for q in quads:
        cv2.fillPoly(m, [np.clip(np.round(np.asarray(q) * 16), -FAR, FAR).astype(np.int32)], 255, cv2.LINE_AA, 4)
    m = m.astype(np.float32) / 255
    return cv2.GaussianBlur(m, (0, 0), blur) if blur > 0.3 else m


def hull(*points: np.ndarray) -> np.ndarray:
    return cv2.convexHull(np.concatenate(points).astype(np.float32))[:, 0]


class Canvas:
    """The picture under work: `x` (n, n, 3) in 0..1, seen by `cam`, lit by a sun from `sun` (unit vector, towards it)."""

    def __init__(self, rng: Rng, size: int, gsd: float, max_tilt: float):
        self.rng, self.n, self.texel, self.extent = rng, size * UP, gsd / UP, size * gsd
        self.cam = Camera(rng, self.n, self.texel, max_tilt)
        elevation, azimuth = np.deg2rad(rng.uniform(12, 75)), rng.uniform(0, 2 * np.pi)
        self.sun = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        self.dark = rng.uniform(0.15, 0.75)
        self.sky = rgb(rng.uniform(0.6, 1.0), rng.uniform(0.8, 1.0), rng.uniform(1.0, 1.45))
        self.x = np.zeros((self.n, self.n, 3), np.float32)

    def onto_ground(self, p: np.ndarray) -> np.ndarray:
        """Where the shadows of points fall on the plane z = 0."""
        return p - np.outer(p[:, 2] / self.sun[2], self.sun)

    def shade(self, mask: np.ndarray) -> None:
        self.x *= 1 - mask[..., None] * (1 - self.dark * self.sky)

    def shadow(self, polygons) -> None:
        """Darkens polygons (pixels)."""
        blur = self.rng.uniform(0.0, 2.5) * UP
        found = self.window(np.concatenate(polygons), 2 + int(3 * blur)) if len(polygons) else None
        if found is None:
            return
        view, lo = found
        m = poly_mask(max(view.shape[:2]), [p - lo for p in polygons], blur)[: view.shape[0], : view.shape[1], None]
        view *= 1 - m * (1 - self.dark * self.sky)

    def window(self, points: np.ndarray, margin: int = 2):
        """The part of the picture about points: the view and its upper left corner; None where there is none."""
        lo = np.clip(np.floor(points.min(axis=0)).astype(int) - margin, 0, self.n)
        hi = np.clip(np.ceil(points.max(axis=0)).astype(int) + margin + 1, 0, self.n)
        return None if (hi <= lo).any() else (self.x[lo[1] : hi[1], lo[0] : hi[0]], lo)

    def fill(self, polygon: np.ndarray, color, blur: float = 0.0) -> None:
        """Paints a polygon (pixels) in a colour or an array that fits the view."""
        found = self.window(polygon, 2 + int(3 * blur))
        if found is None:
            return
        view, lo = found
        m = poly_mask(max(view.shape[:2]), [polygon - lo], blur)[: view.shape[0], : view.shape[1], None]
        view += (color - view) * m

    def paste(self, tex: np.ndarray, quad: np.ndarray, opacity: float = 1.0) -> None:
        """Paints a texture (h, w, 3) into a quadrilateral (pixels; corners of the texture's pixels at half numbers)."""
        found = self.window(quad)
        if found is None:
            return
        view, lo = found
        th, tw = tex.shape[:2]
        h, _ = cv2.findHomography(np.array([[0, 0], [tw, 0], [tw, th], [0, th]], float) - 0.5, (quad - lo).astype(float))
        if h is None:
            return
        m = poly_mask(max(view.shape[:2]), [quad - lo])[: view.shape[0], : view.shape[1], None] * np.float32(opacity)
        t = cv2.warpPerspective(tex, h, (view.shape[1], view.shape[0]), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        view += (t - view) * m


def rectangle(center, w: float, h: float, angle: float, z: float) -> np.ndarray:
    """Corners (4, 3) in the world of a level rectangle."""
    d, e = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
    c = np.array([center[0], center[1], z])
    return np.array([c - d * w / 2 - e * h / 2, c + d * w / 2 - e * h / 2, c + d * w / 2 + e * h / 2, c - d * w / 2 + e * h / 2])
