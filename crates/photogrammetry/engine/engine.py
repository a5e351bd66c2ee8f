"""Structure from motion by COLMAP (pycolmap), as a process of its own.

One request as a line of JSON on standard input, one JSON object a line on standard output. Where standard input ends, the
caller has gone, and this process ends, too.

    {"stage": "features", "done": 3, "total": 10}        progress: features, matches, mapping
    {"result": {...}}                                     the last line, exit status 0
    {"error": {"code": "...", "message": "..."}}          the last line, exit status 1

A request:

    {"work": "folder for the database", "threads": 2, "seed": 1,
     "cameras": [{"width": 5472, "height": 3648, "focal_px": 4000.0, "other_focal_px": null}],
     "images": [{"path": "/photos/a.jpg", "camera": 0, "enu_m": [east, north, up] or null}]}

Focal lengths are held. Where what the photos state can be read in two ways, `other_focal_px` is the second, and the one under
which points fit better is taken. `enu_m` is the GNSS position in a local frame of the caller, metres. A result holds components, largest first, each in that
frame where `aligned` says so, else in a frame and scale of its own:

    {"cameras": [{"focal_px": .., "k1": .., "k2": ..}],
     "components": [{"aligned": true, "points": [[x, y, z], ..], "reprojection_px": 0.6,
                     "shots": [{"image": 0, "rotation": 3 x 3 camera from world, row by row, "translation": [x, y, z],
                                "points": 812, "reprojection_px": 0.5}]}]}

Cameras: a pixel is u = focal d x + width / 2, d = 1 + k1 r2 + k2 r2^2, the corner of the image at (0, 0).
"""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path

import numpy as np

# Pairs beside the nearest photos say little: they overlap less.
NEIGHBOURS = 16
# Up to so many photos all pairs are tried.
ALL_PAIRS = 24
# Longer side at which features are looked for, pixels.
FEATURE_PX = 3200
MAX_FEATURES = 8192
# Points seen under a smaller angle than this do not fix the plant's shape, degrees.
MIN_ANGLE_DEG = 2.0
# GNSS positions further off than this many times the median are outliers of the alignment.
OUTLIER_RATIO = 5.0
# Least shots with GNSS by which a component is placed, and how far from one line they must lie, metres.
MIN_GNSS_SHOTS = 3
MIN_SPREAD_M = 2.0


class Refused(Exception):
    """What cannot be reconstructed, with a code for programs."""

    def __init__(self, code: str, message: str):
        super().__init__(message)
        self.code = code


def emit(message: dict) -> None:
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


def progress(stage: str, done: int, total: int) -> None:
    emit({"stage": stage, "done": done, "total": total})


def pairs_of(images: list[dict]) -> list[tuple[int, int]]:
    """Pairs of images to match: all of few, else each with its nearest by GNSS; those without GNSS with all."""
    count = len(images)
    if count <= ALL_PAIRS:
        return [(a, b) for a in range(count) for b in range(a + 1, count)]
    known = [i for i in range(count) if images[i]["enu_m"] is not None]
    places = np.array([images[i]["enu_m"] for i in known])
    pairs = {tuple(sorted((i, j))) for i in range(count) if images[i]["enu_m"] is None for j in range(count) if i != j}
    for row, i in enumerate(known):
        # Height counts less: photos from other heights show the same place.
        distances = np.linalg.norm((places - places[row]) * [1.0, 1.0, 0.3], axis=1)
        for column in np.argsort(distances, kind="stable")[1 : NEIGHBOURS + 1]:
            pairs.add(tuple(sorted((i, known[int(column)]))))
    return sorted(pairs)


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation and shift that bring `source` onto `target` by least squares, N x 3 each (Umeyama 1991)."""
    source_mean, target_mean = source.mean(0), target.mean(0)
    a, b = source - source_mean, target - target_mean
    u, singular, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ np.diag(signs) @ vt
    scale = (singular * signs).sum() / (a**2).sum()
    return scale, rotation, target_mean - scale * rotation @ source_mean


def robust_similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray] | None:
    """The same without outliers: the best of all small samples, then of what agrees with it; None where places lie in a line."""
    count = len(source)
    if count < MIN_GNSS_SHOTS or np.linalg.svd(target - target.mean(0), compute_uv=False)[1] < MIN_SPREAD_M:
        return None
    rng = np.random.default_rng(1)
    best, best_median = None, np.inf
    for trial in range(200):
        chosen = np.arange(count) if trial == 0 else rng.choice(count, min(4, count), replace=False)
        spread = np.linalg.svd(source[chosen] - source[chosen].mean(0), compute_uv=False)
        if spread[1] <= 1e-6 * max(spread[0], 1e-12):
            continue
        fit = similarity(source[chosen], target[chosen])
        median = np.median(residuals(fit, source, target))
        if median < best_median:
            best, best_median = fit, median
    for _ in range(3):
        if best is None:
            return None
        errors = residuals(best, source, target)
        inliers = errors <= max(OUTLIER_RATIO * np.median(errors), 1e-6)
        if inliers.sum() < MIN_GNSS_SHOTS:
            return None
        best = similarity(source[inliers], target[inliers])
    return best


def residuals(fit: tuple[float, np.ndarray, np.ndarray], source: np.ndarray, target: np.ndarray) -> np.ndarray:
    scale, rotation, shift = fit
    return np.linalg.norm(scale * source @ rotation.T + shift - target, axis=1)


def link_photos(images: list[dict], folder: Path) -> list[str]:
    """Photos under names of our own, so that no name of theirs meets COLMAP's files."""
    folder.mkdir(parents=True, exist_ok=True)
    names = []
    for index, image in enumerate(images):
        name = f"{index:06d}{Path(image['path']).suffix.lower()}"
        link = folder / name
        if not link.is_symlink():
            os.symlink(Path(image["path"]).resolve(), link)
        names.append(name)
    return names


def extract(pycolmap, request: dict, names: list[str], database: Path, photos: Path) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = request["threads"]
    options.max_image_size = FEATURE_PX
    options.sift.max_num_features = MAX_FEATURES
    done = 0
    for index, camera in enumerate(request["cameras"]):
        of_camera = [name for name, image in zip(names, request["images"], strict=True) if image["camera"] == index]
        if not of_camera:
            continue
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "RADIAL"
        reader.camera_params = f"{camera['focal_px']},{camera['width'] / 2},{camera['height'] / 2},0,0"
        # A camera for all its photos: the first call makes it, the others name it.
        for start in range(0, len(of_camera), 4):
            with pycolmap.Database.open(database) as known:
                made = sorted(camera.camera_id for camera in known.read_all_cameras())
            if start > 0:
                reader.existing_camera_id = made[-1]
            pycolmap.extract_features(
                database,
                photos,
                of_camera[start : start + 4],
                pycolmap.CameraMode.SINGLE,
                reader,
                options,
                pycolmap.Device.cpu,
            )
            done += len(of_camera[start : start + 4])
            progress("features", done, len(names))


def match(pycolmap, request: dict, names: list[str], database: Path, work: Path) -> None:
    pairs = pairs_of(request["images"])
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = request["threads"]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = request["seed"]
    listed = work / "pairs.txt"
    step = max(1, min(64, len(pairs) // 20))
    for start in range(0, len(pairs), step):
        batch = pairs[start : start + step]
        listed.write_text("".join(f"{names[a]} {names[b]}\n" for a, b in batch))
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = listed
        pycolmap.match_image_pairs(database, options, pairing, verification, pycolmap.Device.cpu)
        progress("matches", start + len(batch), len(pairs))


def map_incrementally(pycolmap, request: dict, database: Path, photos: Path, work: Path) -> list:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = request["threads"]
    options.random_seed = request["seed"]
    options.min_model_size = 3
    options.extract_colors = False
    # Held: photos from one or two heights would trade it for a dome in the ground.
    options.ba_refine_focal_length = False
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.init_min_tri_angle = 6.0
    total = len(request["images"])
    placed = [0]

    def next_image() -> None:
        placed[0] = min(placed[0] + 1, total)
        progress("mapping", placed[0], total)

    sparse = work / "sparse"
    sparse.mkdir(exist_ok=True)
    made = pycolmap.incremental_mapping(database, photos, sparse, options, next_image_callback=next_image)
    components = [component for component in made.values() if component.num_reg_images() >= 2]
    return sorted(components, key=lambda component: -component.num_reg_images())


def squared_residuals(component) -> float:
    """Sum over all observations of all points, square pixels."""
    total = 0.0
    for point in component.points3D.values():
        for element in point.track.elements:
            image = component.images[element.image_id]
            projected = image.project_point(point.xyz)
            if projected is not None:
                total += float(np.sum((projected - image.points2D[element.point2D_idx].xy) ** 2))
    return total


def choose_focal_lengths(pycolmap, request: dict, components: list, index_of: dict[str, int], work: Path) -> list:
    """Components adjusted with the other reading of a camera's focal length where that fits better."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = False
    options.print_summary = False
    stored = work / "kept"
    for index, camera in enumerate(request["cameras"]):
        if camera["other_focal_px"] is None:
            continue
        changed = []
        for component in components:
            copy = stored / str(len(changed))
            copy.mkdir(parents=True, exist_ok=True)
            component.write(copy)
            other = pycolmap.Reconstruction(copy)
            of_camera = {
                image.camera_id
                for image in other.images.values()
                if request["images"][index_of[image.name]]["camera"] == index
            }
            for camera_id in of_camera:
                params = np.array(other.cameras[camera_id].params)
                params[0] = camera["other_focal_px"]
                other.cameras[camera_id].params = params
            if of_camera:
                pycolmap.bundle_adjustment(other, options)
            changed.append(other)
        # The largest component knows best.
        if squared_residuals(changed[0]) < squared_residuals(components[0]):
            components = changed
    return components


def describe(component, request: dict, index_of: dict[str, int]) -> dict:
    """A component in the caller's frame where GNSS places it."""
    shots = []
    for image_id in sorted(component.reg_image_ids()):
        image = component.images[image_id]
        pose = image.cam_from_world()
        shots.append((index_of[image.name], pose.rotation.matrix(), np.array(pose.translation), image))
    centers = np.array([-rotation.T @ translation for _, rotation, translation, _ in shots])
    gnss = [request["images"][index]["enu_m"] for index, *_ in shots]
    known = [row for row, place in enumerate(gnss) if place is not None]
    fit = robust_similarity(centers[known], np.array([gnss[row] for row in known])) if known else None
    scale, turn, shift = fit if fit is not None else (1.0, np.eye(3), np.zeros(3))
    errors: dict[int, list[float]] = {}
    points = []
    for point in component.points3D.values():
        for element in point.track.elements:
            errors.setdefault(element.image_id, []).append(point.error)
        points.append((scale * turn @ np.array(point.xyz) + shift).tolist())
    described = []
    for row, (index, rotation, _, image) in enumerate(shots):
        new_rotation = rotation @ turn.T
        center = scale * turn @ centers[row] + shift
        seen = errors.get(image.image_id, [])
        described.append(
            {
                "image": index,
                "rotation": new_rotation.tolist(),
                "translation": (-new_rotation @ center).tolist(),
                "points": len(seen),
                "reprojection_px": float(np.median(seen)) if seen else None,
            }
        )
    return {
        "aligned": fit is not None,
        "points": points,
        "reprojection_px": float(component.compute_mean_reprojection_error()),
        "shots": described,
    }


def reconstruct(request: dict) -> dict:
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value if hasattr(pycolmap.logging, "WARNING") else 1
    work = Path(request["work"])
    work.mkdir(parents=True, exist_ok=True)
    database, photos = work / "database.db", work / "photos"
    names = link_photos(request["images"], photos)
    pycolmap.set_random_seed(request["seed"])
    extract(pycolmap, request, names, database, photos)
    match(pycolmap, request, names, database, work)
    components = map_incrementally(pycolmap, request, database, photos, work)
    if not components:
        raise Refused("nothing_reconstructed", "no two photos fit together: fly with more overlap, in one light")
    index_of = {name: index for index, name in enumerate(names)}
    components = choose_focal_lengths(pycolmap, request, components, index_of, work)
    cameras: list[dict | None] = [None] * len(request["cameras"])
    for image in components[0].images.values():
        index = request["images"][index_of[image.name]]["camera"]
        focal_px, _, _, k1, k2 = components[0].cameras[image.camera_id].params
        cameras[index] = {"focal_px": float(focal_px), "k1": float(k1), "k2": float(k2)}
    return {"cameras": cameras, "components": [describe(component, request, index_of) for component in components]}


def end_with_caller() -> None:
    sys.stdin.read()
    os._exit(1)


def main() -> int:
    try:
        request = json.loads(sys.stdin.readline())
        threading.Thread(target=end_with_caller, daemon=True).start()
        emit({"result": reconstruct(request)})
        return 0
    except Refused as refused:
        emit({"error": {"code": refused.code, "message": str(refused)}})
    except ModuleNotFoundError as missing:
        emit({"error": {"code": "engine_missing", "message": f"{missing}: install pycolmap, or run `make setup`"}})
    return 1


if __name__ == "__main__":
    sys.exit(main())
