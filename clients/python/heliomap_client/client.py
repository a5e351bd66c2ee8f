"""The service's interface, as its /openapi.yaml describes it."""

from __future__ import annotations

import http.client
import json
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

from .connection import Connection, HeliomapError, Json, path_part, plant_path, survey_path
from .upload import UploadReport, upload_folder

FINAL = ("succeeded", "failed", "cancelled")
"""States in which a job does not change any more."""

COPIED_BYTES = 1 << 16
"""How much of a response is in memory at once."""


class Client(Connection):
    """One heliomap service, with a method for each operation that a ground station or a dashboard needs."""

    # Plants and surveys.

    def create_plant(self, name: str) -> Json:
        """Creates a plant, or finds the one of that name."""
        return self.call("POST", "/api/v1/plants", {"name": name})

    def find_plant(self, name: str) -> Json | None:
        """The plant of that name, where the key may see it."""
        return _named(self.items(f"/api/v1/plants?name={path_part(name)}"), name)

    def plants(self) -> Iterator[Json]:
        """All plants that the key may see."""
        return self.items("/api/v1/plants")

    def create_survey(self, plant: str, name: str) -> Json:
        """Creates a survey of a plant, or finds the one of that name."""
        return self.call("POST", f"{plant_path(plant)}/surveys", {"name": name})

    def find_survey(self, plant: str, name: str) -> Json | None:
        """The plant's survey of that name."""
        return _named(self.items(f"{plant_path(plant)}/surveys?name={path_part(name)}"), name)

    def survey(self, plant: str, survey: str) -> Json:
        """A survey: its files, and what is missing before it can be mapped."""
        return self.call("GET", survey_path(plant, survey))

    def upload_folder(
        self,
        plant: str,
        survey: str,
        folder: str | os.PathLike[str],
        *,
        parallel: int = 4,
        on_file: Callable[[Json], None] = lambda _: None,
    ) -> UploadReport:
        """Uploads a survey's folder, `parallel` files at once; unchanged files are skipped, large ones resumed.

        `on_file` is called with the service's answer for each file.
        """
        return upload_folder(self, plant, survey, Path(folder), parallel, on_file)

    # Jobs.

    def start_job(self, plant: str, survey: str, **options: Any) -> Json:
        """Starts the mapping of a survey, or finds its unfinished job."""
        return self.call("POST", f"{survey_path(plant, survey)}/jobs", options)

    def job(self, plant: str, job: str) -> Json:
        """The state of a job."""
        return self.call("GET", f"{plant_path(plant)}/jobs/{path_part(job)}")

    def cancel_job(self, plant: str, job: str) -> Json:
        """Cancels a job."""
        return self.call("POST", f"{plant_path(plant)}/jobs/{path_part(job)}/cancel")

    def follow(self, plant: str, job: str, on_change: Callable[[Json], None] = lambda _: None) -> Json:
        """Waits until a job has ended and gives it. `on_change` is called after every change."""
        path = f"{plant_path(plant)}/jobs/{path_part(job)}/events"
        while True:
            with self.open("GET", path, headers={"Accept": "text/event-stream"}) as stream:
                try:
                    for event in _events(stream):
                        on_change(event)
                        if event["state"] in FINAL:
                            return event
                except (OSError, http.client.HTTPException):
                    pass
            # The connection broke, or the service stopped: the state of the job decides whether to listen again.
            standing = self.job(plant, job)
            if standing["state"] in FINAL:
                on_change(standing)
                return standing
            time.sleep(1)

    # Models.

    def models(self, plant: str) -> Iterator[Json]:
        """A plant's models, the newest first."""
        return self.items(f"{plant_path(plant)}/models")

    def fetch_layer(
        self, plant: str, target: str | os.PathLike[str], layer: str = "modules", version: int | str = "latest"
    ) -> None:
        """Writes a layer of a model (`modules`, `sectors`, `benches` or `lines`) as one GeoJSON file, whole or not at all."""
        path = f"{plant_path(plant)}/models/{path_part(str(version))}/{path_part(layer)}"
        target = Path(target)
        partial = target.with_name(target.name + ".part")

        def copy(answer: http.client.HTTPResponse) -> None:
            with answer, open(partial, "wb") as file:
                while chunk := answer.read(COPIED_BYTES):
                    try:
                        file.write(chunk)
                    except OSError as error:
                        raise HeliomapError(f"{partial} cannot be written: {error}") from error
                # A response of known length that ends early raises no error by itself.
                if answer.length:
                    raise http.client.IncompleteRead(b"", answer.length)

        try:
            self.send("GET", path, {"Accept": "application/geo+json"}, lambda: None, None, copy)
            partial.replace(target)
        finally:
            partial.unlink(missing_ok=True)

    def module(self, plant: str, module: str) -> Json:
        """One module of the newest model, a GeoJSON feature."""
        return self.call("GET", f"{plant_path(plant)}/modules/{path_part(module)}")


def _named(items: Iterator[Json], name: str) -> Json | None:
    """The item with exactly that name."""
    return next((item for item in items if item["name"] == name), None)


def _events(stream: IO[bytes]) -> Iterator[Json]:
    """The data of server-sent events."""
    data: list[str] = []
    for raw in stream:
        line = raw.decode().rstrip("\r\n")
        if line.startswith("data:"):
            data.append(line[5:].lstrip())
        elif not line and data:
            yield json.loads("\n".join(data))
            data = []
