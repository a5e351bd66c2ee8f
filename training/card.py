"""The model card, written by `training.evaluate --card`."""

from __future__ import annotations

from pathlib import Path

from .sources import VALIDATION_PLANTS

GLARE_SHARE = 0.3  # of a module's pixels saturated: it is counted apart

UNET = """A small residual U-Net that marks photovoltaic modules in drone photos. It is ours, under this repository's licence.

| | |
|---|---|
| input `image` | float32 [N, 3, H, W], RGB in 0..1, H and W multiples of 32 |
| output `masks` | float32 [N, 2, H, W], probabilities: `module` (the face within its four corners), `core` (the face shrunk to {shrink} about its centre, so that neighbours never touch) |
"""

YOLO = """A small instance network that finds photovoltaic modules in drone photos, with the outputs of YOLOv8-seg. Architecture, code and weights are
ours, under this repository's licence; nothing of the `ultralytics` package is in it. It shares the U-Net's trunk in training; its
own heads learned in the last 11100 steps alone.

| | |
|---|---|
| input `images` | float32 [N, 3, H, W], RGB in 0..1, H and W multiples of 32 |
| output `output0` | float32 [N, 37, A], A = H W / 64 anchors: box cx, cy, w, h in pixels (corners at whole numbers), score, 32 mask coefficients |
| output `output1` | float32 [N, 32, H/4, W/4] prototypes; a mask is where coefficients times prototypes is positive, within the box. The last six are 1, x, y, x^2, xy, y^2 |
"""

HEAD = """# {name}

Version {version}, {size:.1f} MB, {steps} steps of training. Written by `python -m training.evaluate`: do not edit.

{what}| working distance | {gsd_range} m per pixel; photos outside of it are scaled to {gsd} m. Trained for modules whose short side is 9 to 44 pixels |
| speed | {speed:.2f} s of processor time per megapixel, ONNX Runtime, one thread, {kind}, best of four 1344 x 896 images in the run that wrote this card |

Metadata of the file (`heliomap.*`) says the same to programs. From the outputs to boxes: `training/{post}`.

## Data

| source | use | licence |
|---|---|---|
| rendered plants `train/00` to `09`, `14` to `59` but nine of these, 141 photos | training | ours, CC0 |
| rendered plants {validation}, 27 photos | validation: thresholds were chosen there | ours, CC0 |
| drawn pictures, endless (`training/draw/`) | training | ours |
| `real-labelled`: four of five hand-labelled frames of one real plant | training | MIT, as its source states |
| `real-solarseg`: the first of two orthophoto tiles of a real plant | training | MIT, as its source states |
{own}| rendered plants `train/10` to `13`, `example` | test | ours, CC0 |
| `real-labelled/tsukuba_vegetation` | test (same plant as the four above, another frame) | MIT, as its source states |
| `real-solarseg`: the second tile | test (same plant as the first) | MIT, as its source states |
| `flight-halfcut`: a rendered flight over half-cut modules with black frames | test | ours, CC0 |
| `real-halfcut`: eight frames of real roofs with half-cut modules, labels in `training/labels` | validation | photos: no licence stated, not shipped, never trained on; labels: ours |
| `missouri-west`, 21 frames of the northernmost flight line, labels in `training/labels` | test | photos: no licence stated, not shipped; labels: ours |

No photo of any of these is in the repository. The example is rendered like the training plants, but no photo of it was
trained on.

## Figures

Boxes against the modules wholly inside the frame; a match has an IoU of at least 0.5. "Worst" is the recall of the
worst photo. Centre errors are medians, in pixels of the photo as given (the real frames run at half and a third of
their size). Splits: modules with two boxes. Merges: boxes over two modules. Boxes are those of the reference
in `training/`; the service measures them more finely. Modules of which more than {glare:.0f} % is saturated by glare are
counted apart, in the last column: found of all.
The labels of the northern frames were proposed by an earlier network, made regular by fitting
each bench's lattice, then checked and corrected by eye, frame by frame; benches that the frame cuts are ignored. They say much about
misses and merges, less about centres and outlines. They share no ground with a photo trained on.

| set | modules | recall % | worst % | precision % | mean IoU | centre px | splits | merges | under glare |
|---|---|---|---|---|---|---|---|---|---|
"""

CONDITIONS = """
### By condition

The validation plants. The first 5400 steps had seen photos of these plants, the last 11300 had not.

| condition | modules | recall % | worst % | precision % | mean IoU | centre px | splits | merges | under glare |
|---|---|---|---|---|---|---|---|---|---|
"""

OWN = "| `missouri-west`: {frames} frames without labels; lattices fitted to predictions (`training/bootstrap.py`), none of the northernmost flight line | training | its authors state no licence: only weights derived, nothing of the photos ships |\n"

TAIL = """
## Limits

{limits}
"""


def row(name: str, r: dict) -> str:
    return (
        f"| {name} | {r['modules']} | {r['recall']} | {r['worst']} | {r['precision']} | {r['iou']} "
        f"| {r['center_px']} | {r['splits']} | {r['merges']} | {r['glared_found']} of {r['glared']} |\n"
    )


def write_card(path: Path, model: Path, meta: dict, rows: dict, conditions: dict, speed: float) -> None:
    frames = meta.get("heliomap.self_frames", "0")
    version = meta.get("heliomap.version", "?")
    yolo = meta.get("heliomap.kind") == "yolo"
    text = HEAD.format(
        name=model.name,
        what=(YOLO if yolo else UNET).format(shrink=meta.get("heliomap.core_shrink", "?")),
        post="instances.py" if yolo else "postprocess.py",
        kind="8-bit weights and activations" if version.endswith(".int8") else "float32",
        version=version,
        size=model.stat().st_size / 1e6,
        steps=meta.get("heliomap.steps", "?"),
        gsd=meta.get("heliomap.gsd_m", "?"),
        gsd_range=meta.get("heliomap.gsd_range_m", "?").replace(",", " to "),
        validation=", ".join(f"`{p}`" for p in VALIDATION_PLANTS),
        glare=100 * GLARE_SHARE,
        speed=speed,
        own=OWN.format(frames=frames) if frames != "0" else "",
    )
    text += "".join(row(name, r) for name, r in rows.items())
    text += CONDITIONS + "".join(row(name, r) for name, r in conditions.items())
    limits = Path(__file__).with_name("limits.md")
    text += TAIL.format(limits=limits.read_text().strip() if limits.exists() else "")
    path.write_text(text)
