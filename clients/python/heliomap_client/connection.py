"""HTTP to the service: requests, retries, problems, lists."""

from __future__ import annotations

import http.client
import json
import random
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from typing import IO, Any, Protocol, TypeVar

Json = dict[str, Any]
"""A JSON object as the service answers it."""

T = TypeVar("T")


class HeliomapError(Exception):
    """Base of all errors that this client raises."""


class Problem(HeliomapError):
    """The service refused a request, with the reason (RFC 9457)."""

    def __init__(self, status: int, document: Json, retry_after_s: float | None = None):
        self.status = status
        self.document = document
        self.retry_after_s = retry_after_s
        """How long the service asks to wait, if it does."""
        self.code: str = document.get("code", str(status))
        """The stable code of the problem."""
        super().__init__(f"{self.code}: {document.get('detail') or document.get('title') or 'no reason was given'}")


class Unreachable(HeliomapError):
    """The service did not answer any attempt."""


class _Body(Protocol):
    def read(self, size: int = ..., /) -> bytes: ...


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """Follows no redirect, so that the key reaches no other service."""

    def redirect_request(self, *_: Any) -> None:
        return None


class Connection:
    """One heliomap service.

    `url` is its address without a path, `key` a key of it (none where it runs with `--insecure`). A request that fails for
    the network, or is asked to come later, is sent again up to `tries` times in all with growing pauses; all requests of
    this client may be repeated without harm. `timeout_s` is how long the line may stand still.
    """

    def __init__(self, url: str, key: str | None = None, *, timeout_s: float = 60.0, tries: int = 8):
        parts = urllib.parse.urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.netloc:
            raise ValueError(f"`{url}` is no address of a service, such as http://127.0.0.1:8080")
        self._root = f"{parts.scheme}://{parts.netloc}"
        self._key = key
        self._timeout_s = timeout_s
        self._tries = max(1, tries)
        self._opener = urllib.request.build_opener(_NoRedirect)

    def open(
        self,
        method: str,
        path: str,
        *,
        headers: Mapping[str, str] | None = None,
        body: Callable[[], bytes | _Body | None] = lambda: None,
        tries: int | None = None,
    ) -> http.client.HTTPResponse:
        """Sends a request and gives its answer to be read. `body` makes the body anew for each try.

        Raises `Problem` where the service refuses, `Unreachable` where it does not answer.
        """
        return self.send(method, path, headers, body, tries, lambda answer: answer)

    def send(
        self,
        method: str,
        path: str,
        headers: Mapping[str, str] | None,
        body: Callable[[], bytes | _Body | None],
        tries: int | None,
        read: Callable[[http.client.HTTPResponse], T],
    ) -> T:
        """As `open`; what `read` makes of the answer, asked for anew where the line breaks while it reads."""
        tries = tries or self._tries
        for attempt in range(1, tries + 1):
            request = urllib.request.Request(self._root + path, data=body(), method=method, headers=dict(headers or {}))
            if self._key:
                request.add_header("Authorization", f"Bearer {self._key}")
            try:
                return read(self._opener.open(request, timeout=self._timeout_s))
            except urllib.error.HTTPError as answer:
                with answer:
                    wait = answer.headers.get("Retry-After", "")
                    problem = Problem(answer.code, _document(answer), float(wait) if wait.isdigit() else None)
                # Worth another attempt: busy, overloaded, stalled, interrupted, failing.
                if attempt == tries or not (
                    answer.code in (408, 423, 429) or answer.code >= 500 or problem.code == "upload_interrupted"
                ):
                    raise problem from None
                pause = pause_s(attempt) if problem.retry_after_s is None else problem.retry_after_s
            except (OSError, http.client.HTTPException) as error:
                if attempt == tries:
                    raise Unreachable(f"{self._root} does not answer: {error}") from error
                pause = pause_s(attempt)
            time.sleep(pause)
        raise AssertionError("the last try returns or raises")

    def call(self, method: str, path: str, value: Json | None = None) -> Json:
        """Sends JSON, gives JSON."""
        headers = {"Accept": "application/json"}
        if value is not None:
            headers["Content-Type"] = "application/json"
        encoded = None if value is None else json.dumps(value).encode()

        def text(answer: http.client.HTTPResponse) -> bytes:
            with answer:
                return answer.read()

        received = self.send(method, path, headers, lambda: encoded, None, text)
        return json.loads(received) if received else {}

    def items(self, path: str) -> Iterator[Json]:
        """All items of a list, part by part."""
        following: str | None = path
        while following:
            part = self.call("GET", following)
            yield from part["items"]
            following = part.get("next")


def path_part(text: str) -> str:
    """A text as one part of a path."""
    return urllib.parse.quote(text, safe="")


def plant_path(plant: str) -> str:
    """The path of a plant."""
    return f"/api/v1/plants/{path_part(plant)}"


def survey_path(plant: str, survey: str) -> str:
    """The path of a survey."""
    return f"{plant_path(plant)}/surveys/{path_part(survey)}"


def pause_s(attempt: int) -> float:
    """Seconds before the next attempt: doubled each time, at most 30, plus a random share of up to half."""
    return min(30.0, 0.25 * 2.0**attempt) * random.uniform(1.0, 1.5)


def _document(answer: IO[bytes]) -> Json:
    try:
        document = json.loads(answer.read())
    except (ValueError, OSError, http.client.HTTPException):
        return {}
    return document if isinstance(document, dict) else {}
