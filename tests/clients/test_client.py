"""The Python client against the real service."""

from __future__ import annotations

import contextlib
import hashlib
import http.server
import io
import json
import os
import sys
import tempfile
import threading
import unittest
from pathlib import Path

from service import ROOT, Service, lay_out_example

sys.path.insert(0, str(ROOT / "clients" / "python"))
from heliomap_client import Client, Problem, Unreachable, survey_files
from heliomap_client import upload as uploading
from heliomap_client.cli import main


class ClientTest(unittest.TestCase):
    def setUp(self) -> None:
        self.folder = Path(self.enterContext(tempfile.TemporaryDirectory(prefix="heliomap-client-")))

    def client(self, *arguments: str) -> Client:
        self.service = self.enterContext(Service(self.folder / "data", *arguments))
        return Client(self.service.url, self.service.key, timeout_s=30)

    def test_a_folder_becomes_a_plant(self) -> None:
        client = self.client()
        survey = self.folder / "survey"
        lay_out_example(survey)
        target = self.folder / "plant.geojson"
        arguments = ["map", str(survey), "--plant", "Sunfield", "--survey", "June", "--out", str(target)]
        output = io.StringIO()
        with contextlib.redirect_stdout(output):
            status = main(["--url", self.service.url, "--key", self.service.key, *arguments])
        self.assertEqual(status, 0, output.getvalue())
        self.assertIn("succeeded", output.getvalue())
        modules = json.loads(target.read_text())["features"]
        counted = json.loads((survey / "truth.json").read_text())["counts"]["modules"]
        self.assertEqual(len(modules), counted)

        plant = next(client.plants())["id"]
        model = next(client.models(plant))
        self.assertEqual(model["version"], 1)
        one = modules[0]
        self.assertEqual(client.module(plant, one["id"])["properties"]["label"], one["properties"]["label"])
        with self.assertRaises(Problem) as raised:
            client.module(plant, plant)
        self.assertEqual((raised.exception.status, raised.exception.code), (404, "module_not_found"))

    def test_unchanged_files_are_skipped_and_faults_are_reported(self) -> None:
        client = self.client("--no-worker")
        survey = self.folder / "survey"
        lay_out_example(survey)
        (survey / "images" / "broken.jpg").write_bytes(b"no photo")
        plant = client.create_plant("Sunfield")["id"]
        here = client.create_survey(plant, "June")["id"]
        first = client.upload_folder(plant, here, survey)
        files = dict(survey_files(survey))
        self.assertEqual(len(first.stored), len(files) - 1)
        self.assertEqual(
            {path: problem.code for path, problem in first.refused.items()}, {"images/broken.jpg": "image_unreadable"}
        )
        self.assertEqual(first.warned, [])
        again = client.upload_folder(plant, here, survey)
        self.assertEqual((again.stored, again.skipped), ([], len(files) - 1))
        stored = {file["path"]: file["sha256"] for file in client.survey(plant, here)["files"]}
        files.pop("images/broken.jpg")
        self.assertEqual(stored, {path: hashlib.sha256(file.read_bytes()).hexdigest() for path, file in files.items()})

    def test_a_large_file_survives_kills_of_the_service_and_of_the_client(self) -> None:
        client = self.client("--no-worker")
        survey = self.folder / "survey"
        (survey / "undistorted" / "depthmaps").mkdir(parents=True)
        cloud = survey / "undistorted" / "depthmaps" / "merged.ply"
        properties = b"".join(b"property float %s\n" % name for name in (b"x", b"y", b"z"))
        head = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n" + properties + b"end_header\n" + bytes(12)
        # A cloud of one point; what follows is no part of it.
        cloud.write_bytes(head + os.urandom(uploading.RESUMED_BYTES + (8 << 20)))
        plant = client.create_plant("Sunfield")["id"]
        here = client.create_survey(plant, "June")["id"]

        # A client that gives up at once stands for one that is killed; it leaves an address behind.
        self.service.kill()
        with self.assertRaises(Unreachable):
            Client(self.service.url, self.service.key, tries=1).upload_folder(plant, here, survey)
        self.service.start()
        state = survey / uploading.STATE_FILE
        digest = hashlib.sha256(cloud.read_bytes()).hexdigest()
        place = f"/api/v1/plants/{plant}/surveys/{here}"
        headers = {
            **uploading.TUS,
            "Upload-Length": str(cloud.stat().st_size),
            "Upload-Metadata": "path dW5kaXN0b3J0ZWQvZGVwdGhtYXBzL21lcmdlZC5wbHk=",
        }
        with client.open("POST", f"{place}/uploads", headers=headers, body=lambda: b"") as answer:
            url = answer.headers["Location"]
        begun = 5 << 20
        headers = {**uploading.TUS, "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
        client.open("PATCH", url, headers=headers, body=lambda: cloud.read_bytes()[:begun]).close()
        state.write_text(json.dumps({f"{place} undistorted/depthmaps/merged.ply": [url, digest]}))

        # The service dies while the rest is on its way, and comes back.
        def restart() -> None:
            self.service.kill()
            self.service.start()

        killer = threading.Timer(0.05, restart)
        killer.start()
        report = client.upload_folder(plant, here, survey)
        killer.join()
        self.assertEqual([file["sha256"] for file in report.stored], [digest])
        self.assertFalse(state.exists())
        self.assertEqual(
            client.open("HEAD", url, headers=uploading.TUS).headers["Upload-Offset"], str(cloud.stat().st_size)
        )

    def test_a_key_for_one_plant_maps_it_and_creates_no_other(self) -> None:
        client = self.client("--no-worker")
        survey = self.folder / "survey"
        lay_out_example(survey)
        plant = client.create_plant("Sunfield")["id"]
        client.create_plant("Sunfield North")

        def run(scope: str, *arguments: str) -> tuple[int, str]:
            asked = {"name": scope, "scopes": [scope], "plants": [plant]}
            key = client.call("POST", "/api/v1/keys", asked)["secret"]
            output = io.StringIO()
            with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
                status = main(["--url", self.service.url, "--key", key, *arguments])
            return status, output.getvalue()

        here = ("--plant", "Sunfield", "--survey", "June")
        target = self.folder / "plant.geojson"
        status, output = run("upload", "map", str(survey), *here, "--out", str(target))
        self.assertEqual((status, "read" in output, "stored" in output), (1, True, False), output)
        self.assertEqual(run("upload", "upload", str(survey), *here)[0], 0)
        self.assertEqual(run("upload", "start", *here)[0], 0)
        for name, why in (
            ("Sunfield", "model_not_found"),
            ("Sunfeld", "no plant of the name"),
            ("Sunfield North", "no plant"),
        ):
            status, output = run("read", "fetch", "--plant", name, "--out", str(target))
            self.assertEqual((status, why in output), (1, True), output)
        status, output = run("upload", "start", "--plant", "Sunfield", "--survey", "Jun")
        self.assertEqual((status, "no survey of the name" in output), (1, True), output)
        self.assertEqual([plant["name"] for plant in client.plants()], ["Sunfield", "Sunfield North"])

    def test_a_truncated_response_is_requested_again(self) -> None:
        whole = json.dumps({"type": "FeatureCollection", "features": [], "padding": "x" * 100_000}).encode()
        answers: list[str] = []

        class Breaking(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                kind = answers.pop(0)
                self.send_response(200)
                self.send_header("Connection", "close")
                if kind == "chunks":
                    self.send_header("Transfer-Encoding", "chunked")
                    self.end_headers()
                    self.wfile.write(b"%x\r\n" % len(whole) + whole[:50_000])
                else:
                    self.send_header("Content-Length", str(len(whole)))
                    self.end_headers()
                    self.wfile.write(whole if kind == "whole" else whole[:50_000])
                self.close_connection = True

            def log_message(self, *_: object) -> None:
                pass

        server = self.enterContext(http.server.HTTPServer(("127.0.0.1", 0), Breaking))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        self.addCleanup(server.shutdown)
        client = Client(f"http://127.0.0.1:{server.server_port}", tries=3)
        target = self.folder / "plant.geojson"
        answers[:] = ["chunks", "length", "whole"]
        client.fetch_layer("p", target)
        self.assertEqual(target.read_bytes(), whole)
        answers[:] = ["chunks", "length", "whole"]
        self.assertEqual(client.job("p", "j"), json.loads(whole))
        target.unlink()
        answers[:] = ["chunks", "length", "chunks"]
        with self.assertRaises(Unreachable):
            client.fetch_layer("p", target)
        self.assertEqual(list(self.folder.iterdir()), [])

    def test_an_invalid_key_fails_at_once(self) -> None:
        self.client("--no-worker")
        stranger = Client(self.service.url, "hm_wrong")
        with self.assertRaises(Problem) as raised:
            stranger.create_plant("x")
        self.assertEqual(raised.exception.code, "unauthorized")
        with self.assertRaises(ValueError):
            Client("127.0.0.1")


if __name__ == "__main__":
    unittest.main()
