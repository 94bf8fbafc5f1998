# Generated from _async by `generate`. Do not edit.
"""Training jobs."""

from __future__ import annotations

import builtins
import json
import os
import uuid
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

from .._files import replace_file
from .._progress import JobBar
from .._values import instance, mapping, text, texts
from ..errors import DeadlineExceeded, JobEnded, NotFound, QedgixError, from_http, invalid
from ..results import Attempt, Checkpoint, JobEvent, Metric, Metrics, given_instant, instant
from ._platform import sleep
from .transport import Transport

if TYPE_CHECKING:
    from typing_extensions import Self

# Seconds without any byte, also no heartbeat of the server, after which a stream of events is opened again.
_SILENCE = 60.0


class Job:
    """A training job of a server. Its properties are those of the last answer; `refresh` asks again.

    Obtain one from `client.jobs.submit`, `get` or `list`.
    """

    def __init__(self, transport: Transport, document: Mapping[str, Any]) -> None:
        self._transport = transport
        self.document = document
        """Everything that the server tells, as JSON: all fields of docs of the REST interface."""

    @property
    def id(self) -> str:
        """Id of the job."""
        return str(self.document["id"])

    @property
    def state(self) -> str:
        """queued, running, paused, cancelled, succeeded or failed."""
        return str(self.document["state"])

    @property
    def has_ended(self) -> bool:
        """Whether the state is cancelled, succeeded or failed."""
        return self.state in ("cancelled", "succeeded", "failed")

    @property
    def reason(self) -> str | None:
        """Why the job failed, or why its last attempt ended."""
        return self.document["reason"]  # type: ignore[no-any-return]

    @property
    def name(self) -> str | None:
        """Name of the job and of the policy that it publishes."""
        return self.document["name"]  # type: ignore[no-any-return]

    @property
    def policy(self) -> str | None:
        """NAME:VERSION of the published policy; None: it has published none."""
        return self.document["policy"]  # type: ignore[no-any-return]

    @property
    def step(self) -> int:
        """Environment steps completed."""
        return int(self.document["progress"]["step"])

    @property
    def steps(self) -> int:
        """Environment steps of the whole job."""
        return int(self.document["progress"]["steps"])

    @property
    def config(self) -> dict[str, Any]:
        """The resolved configuration: `algorithm`, `preset`, `environment`, `training`, `threads`, `seed`, ..."""
        names = ("algorithm", "preset", "environment", "training", "threads", "priority", "seed", "labels")
        return {name: self.document.get(name) for name in names}

    @property
    def created_at(self) -> datetime:
        """When it was submitted."""
        return given_instant(self.document["created_at"])

    @property
    def _path(self) -> str:
        return f"/v1/jobs/{self.id}"

    def refresh(self) -> Self:
        """Asks the server for the state of the job.

        Raises:
            NotFound: the job was deleted.
        """
        self.document = self._transport.json("GET", self._path)
        return self

    def _change(self, verb: str, done: tuple[str, ...]) -> Self:
        try:
            self.document = self._transport.json("POST", f"{self._path}/{verb}")
        except QedgixError as error:
            # A repetition of a change that has happened is refused; what matters is that it has happened.
            if error.code != "wrong_state" or not done or (self.refresh()).state not in done:
                raise
        return self

    def cancel(self) -> Self:
        """Cancels the job; a running job is cancelled when its worker has stopped.

        Raises:
            FailedPrecondition: `wrong_state`: the job has ended otherwise.
        """
        return self._change("cancel", ())

    def pause(self) -> Self:
        """Pauses the job; a running job is paused when its worker has stored a snapshot.

        Raises:
            FailedPrecondition: `wrong_state`: the job has ended.
        """
        return self._change("pause", ())

    def resume(self) -> Self:
        """Puts a paused job back into the queue; it continues from its snapshot. A job that is queued or running stays so.

        Raises:
            FailedPrecondition: `wrong_state`: the job has ended.
        """
        return self._change("resume", ("queued", "running"))

    def retry(self) -> Self:
        """Puts a failed job back into the queue; it continues from its snapshot.

        Raises:
            FailedPrecondition: `wrong_state`: the job has ended otherwise.
        """
        return self._change("retry", ())

    def continue_(self, steps: int, *, idempotency_key: str | None = None) -> Job:
        """Trains further than a training job that has ended, in a new job with the same configuration, name and labels. The new
        job begins with the snapshot of this one if that is kept, or else with its last weights.

        Args:
            steps: environment steps to train further.
            idempotency_key: a second call with this key returns the same job. Default: a random key.

        Raises:
            FailedPrecondition: `wrong_state`: the job has not ended.
        """
        headers = _key(idempotency_key)
        body = {"steps": steps}
        document = self._transport.json("POST", f"{self._path}/continue", json=body, headers=headers)
        return Job(self._transport, document)

    def edit(self, **fields: Any) -> Self:
        """Changes `name`, `labels`, `priority` or `notes` of the job. None: the default; a label that is None is removed.

        Raises:
            InvalidArgument: a field is not accepted.
        """
        self.document = self._transport.json("PATCH", self._path, json=fields)
        return self

    def result(self) -> dict[str, Any]:
        """The result of an evaluation or a sweep, as JSON (docs/jobs.md of the server).

        Raises:
            FailedPrecondition: `wrong_state`: the job has no result, or none yet.
        """
        return self._transport.json("GET", f"{self._path}/result")

    def delete(self) -> None:
        """Deletes the job with its metrics and checkpoints. The policy that it has published stays.

        Raises:
            FailedPrecondition: `wrong_state`: the job has not ended.
        """
        self._transport.request("DELETE", self._path)

    def events(self, after: int = 0, *, patience: float = 60.0) -> Iterator[JobEvent]:
        """All events of the job in order, past ones first, until the job ends. Continues after a lost connection and after a
        restart of the server, without loss or repetition.

        Args:
            after: only events with a greater id.
            patience: seconds without a server after which to give up.

        Raises:
            NotFound: the job was deleted.
            Unavailable: there was no server for `patience` seconds.
        """
        for event in self._follow(after, patience, None):
            yield event

    def _follow(self, after: int, patience: float, deadline: float | None) -> Iterator[JobEvent]:
        import httpx

        retry = self._transport.settings.retry
        last_success = monotonic()
        failures = 0
        while True:
            failure: QedgixError | None = None
            first = after
            silence = _SILENCE if deadline is None else min(_SILENCE, max(deadline - monotonic(), 0.001))
            limits = httpx.Timeout(self._transport.settings.timeout, read=silence)
            try:
                request = self._transport.http.stream("GET", f"{self._path}/events", params={"after": after}, timeout=limits)
                with request as response:
                    if response.status_code == 204:
                        return
                    if not response.is_success:
                        response.read()
                        raise from_http(response)
                    kind = data = event_id = ""
                    for line in response.iter_lines():
                        last_success, failures = monotonic(), 0
                        name, _, value = line.partition(":")
                        value = value.removeprefix(" ")
                        if name == "id":
                            event_id = value
                        elif name == "event":
                            kind = value
                        elif name == "data":
                            data = value
                        elif not line and data:
                            after = int(event_id)
                            event = JobEvent.of(after, kind, json.loads(data))
                            kind = data = event_id = ""
                            yield event
            except (httpx.TransportError, OSError) as error:
                failure = self._transport.http_failure(error)
            except QedgixError as error:
                failure = error
            if deadline is not None and monotonic() >= deadline:
                raise DeadlineExceeded(f"job {self.id} has not ended in time", code="deadline_exceeded")
            remaining = last_success + patience - monotonic()
            # A stream that ended by itself is opened again: the answer says whether the job has ended.
            if failure is not None:
                failures += 1
                # What limits these attempts is patience, not their number.
                wait = retry.wait(failure, min(failures, retry.attempts - 1), remaining) if retry.attempts > 1 else None
                if wait is None:
                    raise failure
                sleep(wait)
            elif after == first:
                # Something on the way ends streams at once.
                sleep(retry.initial)

    def wait(
        self,
        timeout: float | None = None,
        *,
        progress: bool = False,
        check: bool = True,
        patience: float = 60.0,
    ) -> Self:
        """Waits until the job has ended. A paused job has not ended.

        Args:
            timeout: seconds to wait. Default: no limit.
            progress: whether to show a bar with tqdm, if tqdm is installed.
            check: whether to raise JobEnded if the job fails or is cancelled.
            patience: seconds without a server after which to give up.

        Raises:
            JobEnded: the job has failed or was cancelled.
            DeadlineExceeded: it has not ended within `timeout`. It goes on; wait again.
            Unavailable: there was no server for `patience` seconds.
        """
        deadline = None if timeout is None else self._transport.settings.deadline(timeout)
        with JobBar(self.name or self.id, self.steps, enabled=progress) as bar:
            for event in self._follow(0, patience, deadline):
                bar.show(event)
        self.refresh()
        if check and self.state != "succeeded":
            raise JobEnded(self.id, self.state, self.reason or "")
        return self

    def metrics(self, name: str | None = None) -> Metrics:
        """The metrics of the job: all, or one such as `eval/mean_aoi`. `to_pandas` makes a DataFrame of them."""
        rows = self._transport.pages(f"{self._path}/metrics", "metrics", name=name, page_size=100_000)
        return Metrics([Metric.of(row) for row in rows])

    def checkpoints(self) -> list[Checkpoint]:
        """The best and the last checkpoint, oldest first."""
        document = self._transport.json("GET", f"{self._path}/checkpoints")
        return [Checkpoint.of(one) for one in document["checkpoints"]]

    def download(self, path: str | os.PathLike[str], kind: str = "best", *, timeout: float | None = None) -> Path:
        """Writes a checkpoint to a safetensors file, which appears complete or not at all.

        Args:
            path: the file.
            kind: `best` or `last`.
            timeout: seconds for all attempts. Default: that of the client.

        Raises:
            NotFound: the job has no such checkpoint.
            Internal: the bytes do not have their digest.
        """
        found = [one for one in self.checkpoints() if one.kind == kind]
        if not found:
            raise NotFound(f"job {self.id} has no checkpoint {kind}", code="not_found", field="kind")
        response = self._transport.request("GET", f"/v1/checkpoints/{found[-1].id}", timeout=timeout)
        return replace_file(path, response.content, found[-1].sha256)

    def attempts(self) -> list[Attempt]:
        """The attempts at the job with the last output of their workers, oldest first."""
        document = self._transport.json("GET", f"{self._path}/logs")
        return [
            Attempt(
                one["attempt"],
                one["outcome"],
                one["reason"],
                one["log"],
                given_instant(one["started_at"]),
                instant(one["ended_at"]),
            )
            for one in document["attempts"]
        ]

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.id}: {self.state}, {self.step} of {self.steps} environment steps>"


class Jobs:
    """The jobs of a server, as `client.jobs`."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def submit(
        self,
        *,
        algorithm: str | None = None,
        preset: str | None = None,
        environment: Mapping[str, Any] | None = None,
        training: Mapping[str, Any] | None = None,
        name: str | None = None,
        seed: int | None = None,
        threads: int | None = None,
        priority: int | None = None,
        labels: Mapping[str, str] | None = None,
        idempotency_key: str | None = None,
        **more: Any,
    ) -> Job:
        """Adds a job to the queue. When this returns, the job is in the database of the server.

        Args:
            algorithm: qmix, vdn, iql, qedgix, agggnn or rgcn. Default: qedgix.
            preset: paper, authors or practical. Default: practical.
            environment: fields that replace those of the preset, such as `{"uavs": 3, "users": 5}`.
            training: fields that replace those of the preset, such as `{"steps": 250_000}`.
            name: name of the job and of the policy that it publishes.
            seed: configuration and seed determine every metric and weight. Default: 1.
            threads: threads that the job may use.
            priority: -100 to 100; jobs with a higher one start first. Default: 0.
            labels: labels, which the server does not interpret.
            idempotency_key: a second submission with this key returns the same job. Default: a random key.
            more: further fields of the body of `POST /v1/jobs`, such as `kind="evaluate"` or `kind="sweep"` and theirs.

        Raises:
            InvalidArgument: a field is not accepted; `field` says which.
            AlreadyExists: `idempotency_conflict`: the key belongs to another job.
        """
        fields = {
            "algorithm": algorithm,
            "preset": preset,
            "environment": environment,
            "training": training,
            "name": name,
            "seed": seed,
            "threads": threads,
            "priority": priority,
            "labels": labels,
            **more,
        }
        body = {field: value for field, value in fields.items() if value is not None}
        document = self._transport.json("POST", "/v1/jobs", json=body, headers=_key(idempotency_key))
        return Job(self._transport, document)

    def get(self, job_id: str) -> Job:
        """A job.

        Raises:
            NotFound: there is no such job.
        """
        return Job(self._transport, {"id": job_id}).refresh()

    def list(
        self,
        state: str | None = None,
        *,
        kind: str | None = None,
        algorithm: str | None = None,
        name: str | None = None,
        labels: Mapping[str, str | None] | None = None,
        parent: str | None = None,
        created_after: datetime | None = None,
        created_before: datetime | None = None,
        sort: str | None = None,
        metrics: Sequence[str] = (),
        limit: int | None = None,
    ) -> builtins.list[Job]:
        """All jobs to which every given filter applies. `config` of a listed job lacks environment and training.

        Args:
            state: queued, running, paused, cancelled, succeeded or failed.
            kind: train, evaluate, sweep or experiment.
            algorithm: qmix, vdn, iql, qedgix, agggnn or rgcn.
            name: a name; with `*` at the end, the beginning of names.
            labels: labels that a job has, with their values; None: any value.
            parent: id of the job that has made the jobs, such as a sweep.
            created_after: when jobs were submitted at the earliest. A time without a zone is that of this machine.
            created_before: before when they were submitted.
            sort: `created`, `name`, `best:METRIC` or `last:METRIC`, after `-` in descending order. Default: `-created`.
            metrics: at most 16 metrics whose best and last values `document["metrics"]` of each job has.
            limit: maximum number of jobs. Default: all.

        Raises:
            InvalidArgument: a filter is not accepted.
        """
        filters = {
            "state": state,
            "kind": kind,
            "algorithm": algorithm,
            "name": name,
            "labels": None if labels is None else _labels(labels),
            "parent": parent,
            "created_after": None if created_after is None else _instant("created_after", created_after),
            "created_before": None if created_before is None else _instant("created_before", created_before),
            "sort": sort,
            "metrics": ",".join(texts("metrics", metrics)) or None,
        }
        rows = self._transport.pages("/v1/jobs", "jobs", limit=limit, **filters)
        return [Job(self._transport, row) for row in rows]


def _key(idempotency_key: str | None) -> dict[str, str]:
    """The header that names a submission."""
    key = text("idempotency_key", idempotency_key or uuid.uuid4().hex)
    if not (key.isascii() and key.isprintable()):
        raise invalid("idempotency_key", repr(key), "printable characters of ASCII")
    return {"idempotency-key": key}


def _labels(labels: Mapping[str, str | None]) -> str:
    """The filter for jobs with all of these labels."""
    return ",".join(name if value is None else f"{name}={value}" for name, value in mapping("labels", labels).items())


def _instant(field: str, time: datetime) -> str:
    return instance(field, time, datetime).astimezone().isoformat()
