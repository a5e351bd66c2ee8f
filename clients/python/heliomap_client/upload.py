"""Uploads a folder to a survey: in parallel, resumable, without files that the survey has already."""

from __future__ import annotations

import base64
import concurrent.futures
import hashlib
import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

from .connection import Connection, Json, Problem, Unreachable, pause_s, survey_path

RECONSTRUCTION = (
    "boxes.json",
    "reconstruction.json",
    "reference_lla.json",
    "camera_models.json",
    "undistorted/reconstruction.json",
    "undistorted/undistorted_shot_ids.json",
    "undistorted/depthmaps/merged.ply",
)
IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
RESUMED_BYTES = 16 << 20
"""Files larger than this are sent by tus, so that a broken line costs little of them."""
STATE_FILE = ".heliomap-uploads.json"
"""Where the folder remembers uploads that are not finished."""
TUS = {"Tus-Resumable": "1.0.0"}


@dataclass
class UploadReport:
    """The outcome of an upload of a folder."""

    stored: list[Json] = field(default_factory=list)
    """The service's answers."""
    skipped: int = 0
    """Files that the survey had with the same bytes."""
    refused: dict[str, Problem] = field(default_factory=dict)
    """By path: files that the service refused, and why."""

    @property
    def warned(self) -> list[Json]:
        """Stored files with warnings."""
        return [file for file in self.stored if file.get("warnings")]


def survey_files(folder: Path) -> Iterator[tuple[str, Path]]:
    """The files of a survey's folder with their places in it."""
    for name in RECONSTRUCTION:
        if (folder / name).is_file():
            yield name, folder / name
    for place in ("images", "undistorted/images"):
        if (folder / place).is_dir():
            for path in sorted((folder / place).iterdir()):
                if path.suffix.lower() in IMAGES and path.is_file() and not path.name.startswith("."):
                    yield f"{place}/{path.name}", path


def upload_folder(
    connection: Connection, plant: str, survey: str, folder: Path, parallel: int, on_file: Callable[[Json], None]
) -> UploadReport:
    """As `Client.upload_folder`."""
    files = list(survey_files(folder))
    if not files:
        raise ValueError(
            f"{folder} holds no file of a survey: expected are images/ and reconstruction.json, as OpenSfM has them"
        )
    here = survey_path(plant, survey)
    known = {file["path"]: file["sha256"] for file in connection.call("GET", here)["files"]}
    pending = _Pending(folder / STATE_FILE)
    report = UploadReport()
    lock = threading.Lock()

    def send(place: str, path: Path) -> None:
        digest = _sha256(path)
        if known.get(place) == digest.hex():
            with lock:
                report.skipped += 1
            return
        try:
            if path.stat().st_size > RESUMED_BYTES:
                stored = _resumed(connection, here, place, path, digest, pending)
            else:
                stored = _put(connection, here, place, path, digest)
        except Problem as problem:
            # A key that does not fit, or a survey that is gone, is the same for every file.
            if (
                problem.status in (401, 403)
                or problem.code in ("plant_not_found", "survey_not_found")
                or problem.status >= 500
            ):
                raise
            with lock:
                report.refused[place] = problem
            return
        with lock:
            report.stored.append(stored)
            on_file(stored)

    with concurrent.futures.ThreadPoolExecutor(max_workers=max(1, parallel)) as pool:
        sending = [pool.submit(send, place, path) for place, path in files]
        try:
            for sent in concurrent.futures.as_completed(sending):
                sent.result()
        finally:
            for sent in sending:
                sent.cancel()
    return report


def _sha256(path: Path) -> bytes:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while part := file.read(1 << 20):
            digest.update(part)
    return digest.digest()


def _put(connection: Connection, here: str, place: str, path: Path, digest: bytes) -> Json:
    where = f"images/{quote(place[7:], safe='')}" if place.startswith("images/") else f"reconstruction/{quote(place)}"
    content = path.read_bytes()
    headers = {
        "Content-Type": "application/octet-stream",
        "Repr-Digest": f"sha-256=:{base64.b64encode(digest).decode()}:",
    }
    with connection.open("PUT", f"{here}/{where}", headers=headers, body=lambda: content) as answer:
        return json.loads(answer.read())


class _Pending:
    """Uploads that are not finished, by place: their addresses, and the bytes that they are of."""

    def __init__(self, file: Path):
        self._file = file
        self._lock = threading.Lock()
        try:
            self._known: dict[str, list[str]] = json.loads(file.read_text())
        except (OSError, ValueError):
            self._known = {}

    def get(self, here: str, place: str, digest: bytes) -> str | None:
        """The address of the upload of these bytes."""
        with self._lock:
            url, of = self._known.get(f"{here} {place}", ("", ""))
        return url if of == digest.hex() else None

    def set(self, here: str, place: str, digest: bytes, url: str | None) -> None:
        """Remembers an address, or forgets it."""
        with self._lock:
            self._known.pop(f"{here} {place}", None)
            if url:
                self._known[f"{here} {place}"] = [url, digest.hex()]
            if self._known:
                partial = self._file.with_name(self._file.name + ".part")
                partial.write_text(json.dumps(self._known))
                partial.replace(self._file)
            else:
                self._file.unlink(missing_ok=True)


def _resumed(connection: Connection, here: str, place: str, path: Path, digest: bytes, pending: _Pending) -> Json:
    size = path.stat().st_size
    url = pending.get(here, place, digest)
    offset = None
    if url:
        try:
            with connection.open("HEAD", url, headers=TUS) as answer:
                offset = int(answer.headers["Upload-Offset"])
        except Problem as problem:
            # It was forgotten, or ended: a new one is begun.
            if problem.status not in (404, 410):
                raise
    if url is None or offset is None:
        metadata = f"path {base64.b64encode(place.encode()).decode()}"
        headers = {**TUS, "Upload-Length": str(size), "Upload-Metadata": metadata}
        with connection.open("POST", f"{here}/uploads", headers=headers, body=lambda: b"") as answer:
            url = answer.headers["Location"]
        pending.set(here, place, digest, url)
        offset = 0
    stalled = 0
    while offset < size:
        before = offset
        try:
            with open(path, "rb") as file:
                file.seek(offset)
                headers = {
                    **TUS,
                    "Upload-Offset": str(offset),
                    "Content-Type": "application/offset+octet-stream",
                    "Content-Length": str(size - offset),
                }
                connection.open("PATCH", url, headers=headers, body=lambda: file, tries=1).close()
            offset = size
        except (Unreachable, Problem) as error:
            if isinstance(error, Problem) and not (
                error.status in (408, 409, 423, 429) or error.status >= 500 or error.code == "upload_interrupted"
            ):
                pending.set(here, place, digest, None)
                raise
            # Bytes that arrived count: ask the service how many.
            with connection.open("HEAD", url, headers=TUS) as answer:
                offset = int(answer.headers["Upload-Offset"])
            stalled = stalled + 1 if offset == before else 0
            if stalled >= 8:
                raise
            asked_s = error.retry_after_s if isinstance(error, Problem) else None
            time.sleep(pause_s(stalled) if asked_s is None else asked_s)
    outcome = connection.call("GET", url).get("outcome", {})
    pending.set(here, place, digest, None)
    if outcome.get("problem"):
        raise Problem(outcome["problem"].get("status", 422), outcome["problem"])
    return outcome["files"][0]
