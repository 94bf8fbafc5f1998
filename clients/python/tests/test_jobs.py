"""Jobs and the policies that they publish."""

from __future__ import annotations

import hashlib
import math
import sys
from datetime import timedelta

import numpy as np
import pytest

import qedgix

SMALL = {
    "algorithm": "vdn",
    "environment": {"uavs": 1, "users": 1, "slots": 4},
    "training": {"steps": 400, "eval_every": 200},
}
ENDLESS = {**SMALL, "training": {"steps": 100_000_000}, "threads": 1}


@pytest.fixture
def name(request):
    """A name that no other test uses."""
    return "".join(letter if letter.isalnum() else "-" for letter in request.node.name)[-50:].strip("-")


def test_a_job_from_submission_to_policy(client, name, tmp_path, capsys):
    job = client.jobs.submit(**SMALL, name=name, seed=3, labels={"team": "a"})
    assert job.name == name and job.config["environment"]["uavs"] == 1 and job.config["seed"] == 3
    assert job.config["labels"] == {"team": "a"} and job.steps == 416  # 13 whole iterations of 32
    job.wait(progress=True)
    assert "416" in capsys.readouterr().err
    assert (job.state, job.has_ended, job.policy) == ("succeeded", True, f"{name}:1")
    assert job.step == job.steps

    events = list(job.events())
    assert [event.id for event in events] == list(range(1, len(events) + 1))
    assert [event.state for event in events if event.state] == ["queued", "running", "succeeded"]
    assert list(job.events(after=len(events))) == [] and len(list(job.events(after=2))) == len(events) - 2

    metrics = job.metrics()
    assert "eval/mean_aoi" in metrics.names and len(metrics) > 10
    steps, values = job.metrics("eval/mean_aoi").curve("eval/mean_aoi")
    assert steps[0] == 0 and len(steps) == len(values) >= 2 and (values > 0).all()
    frame = metrics.to_pandas()
    assert list(frame.columns) == ["name", "step", "value", "at"] and len(frame) == len(metrics)
    assert metrics.curve("nothing")[0].size == 0 and metrics[:2].names == [metrics[0].name]

    best = next(one for one in job.checkpoints() if one.kind == "best")
    file = job.download(tmp_path / "best.safetensors")
    assert hashlib.sha256(file.read_bytes()).hexdigest() == best.sha256
    [attempt] = job.attempts()
    assert attempt.outcome == "succeeded" and attempt.ended_at > attempt.started_at > job.created_at

    policies = client.policies
    version = policies.get(job.policy)
    assert (version.ref.name, version.kind, version.uavs) == (name, "checkpoint", version.uavs)
    assert version.ref.digest == best.sha256
    assert policies.export(name, tmp_path / "export.safetensors").read_bytes() == file.read_bytes()
    assert policies.upload(name, file, alias="live").ref == version.ref
    assert policies.publish(name, best.id).ref == version.ref
    assert policies.aliases(name) == {"live": 1}
    assert policies.set_alias(name, "live", 1) == 1
    assert policies.set_alias(name, "next", 1, expected=0) is None
    with pytest.raises(qedgix.FailedPrecondition) as refused:
        policies.set_alias(name, "live", 1, expected=7)
    assert refused.value.code == "alias_moved"
    with client.session(f"{name}@live") as session:
        assert session.act(qedgix.Scene([[0.5, 0.5]], [[0.1, 0.2]])).policy == version.ref
    policies.unload(name)
    with pytest.raises(qedgix.FailedPrecondition) as refused:
        client.open_session(name)
    assert refused.value.code == "policy_unloaded"
    assert policies.load(name).loaded
    with pytest.raises(qedgix.FailedPrecondition):
        policies.delete(name, 1)
    policies.delete_alias(name, "live", expected=1)
    policies.delete_alias(name, "next")
    assert [(move.alias, move.version) for move in policies.history(name, "live")] == [("live", None), ("live", 1)]
    assert [one.ref for one in policies.versions(name)] == [version.ref]
    job.delete()
    policies.delete(name)
    with pytest.raises(qedgix.NotFound):
        policies.get(name)
    with pytest.raises(qedgix.NotFound):
        job.refresh()


def test_pause_resume_and_cancel(client, name):
    job = client.jobs.submit(**ENDLESS, name=name)
    events = job.events()

    def until(state):
        for event in events:
            if event.state == state:
                return job.refresh()
        raise AssertionError(f"the job ended before it was {state}")

    until("running")
    job.pause()
    assert until("paused").state == "paused"
    assert [one.id for one in client.jobs.list("paused") if one.name == name] == [job.id]
    assert job.resume().state in ("queued", "running") and job.resume()
    until("running")
    job.cancel()
    with pytest.raises(qedgix.JobEnded) as ended:
        job.wait()
    assert (ended.value.code, ended.value.state, ended.value.job_id) == ("job_cancelled", "cancelled", job.id)
    with pytest.raises(qedgix.FailedPrecondition) as refused:
        job.resume()
    assert refused.value.code == "wrong_state"
    assert client.jobs.get(job.id).wait(check=False).state == "cancelled"
    with pytest.raises(qedgix.NotFound):
        job.download("nowhere", "best" if not job.checkpoints() else "none")
    job.delete()


def test_a_job_that_takes_longer_than_the_caller_waits_goes_on(client, name):
    job = client.jobs.submit(**ENDLESS, name=name)
    with pytest.raises(qedgix.DeadlineExceeded):
        job.wait(timeout=0.01)
    assert not job.refresh().has_ended
    with pytest.raises(qedgix.FailedPrecondition):
        job.delete()
    job.cancel().wait(check=False)
    job.delete()


def test_a_watcher_survives_the_death_of_the_server(make_server, connect, name):
    server = make_server("--cpu-budget", "2").start()
    client = connect(server)
    job = client.jobs.submit(**ENDLESS, name=name)
    seen = []
    for event in job.events():
        seen.append(event.id)
        if event.state == "running" and len(seen) < 5:
            server.kill()
            server.start()
            seen += [0] * 5
        elif event.state == "running":
            job.cancel()
    ids = [one for one in seen if one]
    assert ids == list(range(1, len(ids) + 1))
    assert job.refresh().state == "cancelled"


def test_an_evaluation_has_a_result(client, name):
    job = client.jobs.submit(kind="evaluate", name=name, evaluation={"policies": ["sweep"], "episodes": 8})
    job.edit(labels={"team": "b"}, notes="a note")
    assert job.document["labels"] == {"team": "b"} and job.document["notes"] == "a note"
    assert job.wait(progress=True).result()
    with pytest.raises(qedgix.InvalidArgument) as refused:
        job.edit(colour="red")
    assert refused.value.field == "colour"
    job.delete()


def test_a_sweep_has_a_result(client, name):
    fields = {key: value for key, value in SMALL.items() if key != "algorithm"}
    job = client.jobs.submit(kind="sweep", name=name, sweep={"grid": {"algorithm": ["vdn", "iql"]}, "seeds": 1}, **fields)
    assert job.wait(progress=True).result()
    children = client.jobs.list(parent=job.id)
    assert [one.state for one in children] == ["succeeded"] * 2
    assert {one.document["parent"] for one in children} == {job.id}
    for policy in {str(one.policy).partition(":")[0] for one in children}:
        client.policies.delete(policy)
    job.delete()


def test_a_list_of_jobs_is_filtered_sorted_and_limited(client, name):
    names = [f"{name}-{i}" for i in range(3)]
    fields = {"training": {"steps": np.int64(400), "eval_every": np.int32(200), "learning_rate": np.float32(0.001)}}
    labels = [{"team": "a"}, {"team": "b"}, {"team": "b", "urgent": ""}]
    jobs = [client.jobs.submit(**{**SMALL, **fields}, name=names[i], seed=np.int64(i), labels=labels[i]) for i in range(3)]
    for job in jobs:
        job.wait()
    assert jobs[2].config["seed"] == 2 and jobs[2].config["training"]["eval_every"] == 200

    def listed(**filters):
        return [one.name for one in client.jobs.list(name=f"{name}-*", **filters)]

    assert listed() == names[::-1] and listed(sort="name") == names
    assert listed(labels={"team": "b"}, sort="created") == names[1:]
    assert listed(labels={"team": "b", "urgent": None}) == names[2:]
    assert listed(state="succeeded", kind="train", algorithm="vdn", limit=2) == names[:0:-1]
    assert listed(kind="sweep") == listed(algorithm="qmix") == listed(parent=jobs[0].id) == []
    assert listed(created_after=jobs[1].created_at, created_before=jobs[2].created_at) == [names[1]]
    assert listed(created_after=jobs[2].created_at + timedelta(seconds=1)) == []
    best = client.jobs.list(name=f"{name}-*", sort="best:eval/mean_aoi", metrics=["eval/mean_aoi"], limit=np.int64(1))
    assert best[0].document["metrics"]["eval/mean_aoi"]
    for filters, field in [({"state": "lazy"}, "state"), ({"limit": 0}, "limit"), ({"sort": "size"}, "sort")]:
        with pytest.raises(qedgix.InvalidArgument) as refused:
            client.jobs.list(**filters)
        assert refused.value.field == field
    for job in jobs:
        job.delete()
        client.policies.delete(str(job.name))


def test_a_job_that_has_ended_is_continued(client, name):
    first = client.jobs.submit(**SMALL, name=name).wait()
    second = first.continue_(np.int64(200), idempotency_key=name)
    assert first.continue_(200, idempotency_key=name).id == second.id != first.id
    assert (second.name, second.steps, second.wait().state) == (name, 224, "succeeded")
    with pytest.raises(qedgix.InvalidArgument) as refused:
        first.continue_(0)
    assert refused.value.field == "steps"
    for job in (first, second):
        job.delete()
    client.policies.delete(name)


def test_an_idempotency_key_names_a_job(client, name):
    first = client.jobs.submit(**SMALL, name=name, idempotency_key=name)
    assert client.jobs.submit(**SMALL, name=name, idempotency_key=name).id == first.id
    with pytest.raises(qedgix.AlreadyExists) as refused:
        client.jobs.submit(**SMALL, name=name, seed=9, idempotency_key=name)
    assert refused.value.code == "idempotency_conflict"
    first.wait().delete()
    client.policies.delete(name)


def test_what_is_not_accepted_is_named(client, tmp_path):
    for field, body in [
        ("training.stepps", {"training": {"stepps": 1}}),
        ("colour", {"colour": "red"}),
        ("threads", {"threads": 0}),
        ("training.learning_rate", {"training": {"learning_rate": float("nan")}}),
        ("training.learning_rate", {"training": {"learning_rate": np.float32(np.inf)}}),
        ("sweep.grid.seed[1]", {"kind": "sweep", "sweep": {"grid": {"seed": [1, {2}]}}}),
        ("labels", {"labels": {None: "a"}}),
    ]:
        with pytest.raises(qedgix.InvalidArgument) as refused:
            client.jobs.submit(**body)
        assert refused.value.field == field
    with pytest.raises(qedgix.NotFound):
        client.jobs.get("01a202d1-93be-769e-80f7-75eef9496f12")
    with pytest.raises(qedgix.InvalidArgument):
        client.policies.upload("broken", b"no checkpoint")
    with pytest.raises(qedgix.FailedPrecondition) as refused:
        client.policies.export("sweep", tmp_path / "sweep")
    assert refused.value.code == "no_checkpoint"
    assert list(tmp_path.iterdir()) == []


def test_files_appear_complete_or_not_at_all(tmp_path):
    from qedgix._files import replace_file

    with pytest.raises(qedgix.Internal):
        replace_file(tmp_path / "file", b"bytes", "0" * 64)
    assert list(tmp_path.iterdir()) == []


def test_a_progress_bar_needs_no_tqdm(monkeypatch):
    from qedgix._progress import JobBar, UploadBar

    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    with JobBar("job", 10, enabled=True) as bar:
        bar.show(qedgix.JobEvent(1, "running", 1, None, qedgix.Metrics(())))
    with UploadBar("policy", 10, enabled=True) as sent:
        sent.restart()
        sent.add(10)


def test_times_and_values_that_are_missing():
    from qedgix.results import instant

    assert instant(None) is None
    assert instant("2026-11-22T12:04:18Z").microsecond == 0
    assert instant("2026-11-22T12:04:18.472905123Z").microsecond == 472905
    row = {"name": "loss", "step": 1, "value": None, "at": "2026-11-22T12:04:18.4Z"}
    assert math.isnan(qedgix.Metric.of(row).value)
