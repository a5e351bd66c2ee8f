"""`heliomap-client`: a survey's folder to a plant's GeoJSON, from the command line."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from .client import Client
from .connection import HeliomapError, Json


def main(arguments: list[str] | None = None) -> int:
    """Runs the command line; the exit status."""
    args = _parser().parse_args(arguments)
    try:
        return args.run(Client(args.url, args.key), args)
    except (HeliomapError, ValueError, OSError) as error:
        print(f"heliomap-client: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("heliomap-client: interrupted; run the same command again to continue", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="heliomap-client", description="Map a photovoltaic plant with a heliomap service."
    )
    parser.add_argument(
        "--url", default=os.environ.get("HELIOMAP_URL", "http://127.0.0.1:8080"), help="the service (HELIOMAP_URL)"
    )
    parser.add_argument(
        "--key", default=os.environ.get("HELIOMAP_KEY"), help="a key of the service (better: HELIOMAP_KEY)"
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, what: str, run: object, *names: str) -> argparse.ArgumentParser:
        one = commands.add_parser(name, help=what, description=what)
        one.set_defaults(run=run)
        if "folder" in names:
            one.add_argument("folder", type=Path, help="a folder as OpenSfM leaves it")
            one.add_argument("--parallel", type=int, default=4, help="files at once")
        made = "; created if missing" if "folder" in names else ""
        one.add_argument("--plant", required=True, help=f"the plant's name{made}")
        if "survey" in names:
            one.add_argument("--survey", required=True, help=f"the survey's name{made}")
        if "out" in names:
            one.add_argument("--out", type=Path, required=True, help="the GeoJSON file to write")
            one.add_argument("--layer", default="modules", choices=["modules", "sectors", "benches", "lines"])
        return one

    command("upload", "Upload a survey's folder", _upload, "folder", "survey")
    command("start", "Start the mapping of a survey, and print its job", _start, "survey")
    command("follow", "Follow a job to its end", _follow).add_argument("job", help="the job's identifier")
    command("fetch", "Fetch the plant as GeoJSON", _fetch, "out")
    command("map", "Upload, start, follow and fetch", _map, "folder", "survey", "out")
    return parser


def _plant(client: Client, args: argparse.Namespace, make: bool = False) -> str:
    """The plant of that name. A key for some plants can find it; only a key for all plants can create it."""
    found = client.find_plant(args.plant) or (client.create_plant(args.plant) if make else None)
    if found is None:
        raise HeliomapError(f"this key sees no plant of the name `{args.plant}`")
    return found["id"]


def _survey(client: Client, args: argparse.Namespace, make: bool = False) -> tuple[str, str]:
    plant = _plant(client, args, make)
    found = client.find_survey(plant, args.survey) or (client.create_survey(plant, args.survey) if make else None)
    if found is None:
        raise HeliomapError(f"the plant has no survey of the name `{args.survey}`")
    return plant, found["id"]


def _upload(client: Client, args: argparse.Namespace) -> int:
    plant, survey = _survey(client, args, make=True)
    report = client.upload_folder(plant, survey, args.folder, parallel=args.parallel, on_file=_print_file)
    for path, problem in report.refused.items():
        print(f"{path}: refused, {problem}", file=sys.stderr)
    print(
        f"{len(report.stored)} stored, {report.skipped} unchanged, {len(report.refused)} refused, {len(report.warned)} with warnings"
    )
    for missing in client.survey(plant, survey)["missing"]:
        print(f"missing: {missing['message']}")
    return 1 if report.refused else 0


def _print_file(file: Json) -> None:
    warnings = "; ".join(warning["message"] for warning in file.get("warnings", []))
    print(f"{file['path']}: {file['result']}{f' ({warnings})' if warnings else ''}", flush=True)


def _start(client: Client, args: argparse.Namespace) -> int:
    plant, survey = _survey(client, args)
    print(client.start_job(plant, survey)["id"])
    return 0


def _follow(client: Client, args: argparse.Namespace) -> int:
    job = client.follow(_plant(client, args), args.job, _print_job)
    return 0 if job["state"] == "succeeded" else 1


def _print_job(job: Json) -> None:
    progress = job.get("progress")
    where = (
        f", {progress['stage']} {progress['done']} of {progress['total']}"
        if progress and job["state"] == "running"
        else ""
    )
    why = f": {job['error']['message']}" if job["state"] == "failed" and job.get("error") else ""
    print(f"{job['state']}{where}{why}", flush=True)


def _fetch(client: Client, args: argparse.Namespace) -> int:
    client.fetch_layer(_plant(client, args), args.out, args.layer)
    print(args.out)
    return 0


def _map(client: Client, args: argparse.Namespace) -> int:
    plant, survey = _survey(client, args, make=True)
    # A key without the scope `read` fails before the work, not after it.
    client.call("GET", f"/api/v1/plants/{plant}/models?limit=1")
    if _upload(client, args):
        return 1
    job = client.follow(plant, client.start_job(plant, survey)["id"], _print_job)
    if job["state"] != "succeeded":
        return 1
    client.fetch_layer(plant, args.out, args.layer, job["model_version"])
    print(args.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
