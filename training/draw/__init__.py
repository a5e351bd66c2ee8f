"""Procedural photos of photovoltaic plants and roofs: a few tens of milliseconds each, with exact polygons.

Benches are textured planes in space, seen by a tilted camera. A bench's texture is separable (seams, frames, cell
gaps, busbars are stripes along its two axes), so that it is integrated exactly over each texel from one-dimensional
profiles of millimetre resolution: a 2 mm seam at 6 cm per pixel keeps its true faint contrast. Only numpy and OpenCV.

`style` has the looks of modules, `bench` their texture, `ground` and `roof` what lies below, `clutter` what stands
about and is no module, `canvas` the camera and how things are painted, `scene` the layout of a whole picture.
"""

from .scene import draw

__all__ = ["draw"]
