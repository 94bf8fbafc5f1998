"""Lost answers, restarts and busy servers: the fleet flies on, and no step is computed twice."""

from __future__ import annotations

import pytest
from proxy import LossyProxy
from test_act import SLOTS, Fleet, expected, fly

import qedgix

HOST = "127.0.0.1"
QUICK = qedgix.Retry(initial=0.001, maximum=0.01)


@pytest.fixture
def lossy(server):
    proxies = [LossyProxy(server.grpc), LossyProxy(server.http)]
    yield proxies
    for proxy in proxies:
        proxy.close()


@pytest.fixture
def clients(connect, server, lossy):
    """A client that loses answers, and one that does not."""
    return connect(lossy[0].address, lossy[1].address, retry=QUICK), connect(server)


def test_a_lost_answer_is_asked_for_again_and_advances_nothing(clients, lossy):
    unlucky, lucky = clients
    wanted = expected(lucky, "qedgix")
    with unlucky.session("qedgix", seed=7) as session:
        for step in range(SLOTS):
            lossy[0].lose(2)
            assert session.act(Fleet(step).scene()).headings.tolist() == wanted[step]
            assert session.step == step + 1
        assert [info.steps for info in lucky.list_sessions() if info.session_id == session.id] == [SLOTS]
    # The answer to the first request of a new connection may come with the greeting of the server.
    assert SLOTS <= lossy[0].lost <= 2 * SLOTS


def test_a_session_whose_opening_or_closing_is_lost_is_opened_and_closed_once(clients, lossy):
    unlucky, lucky = clients
    before = len(unlucky.list_sessions())
    lossy[0].lose(1)
    with unlucky.session("sweep"):
        assert len(lucky.list_sessions()) == before + 1
        lossy[0].lose(1)
    assert len(lucky.list_sessions()) == before
    assert lossy[0].lost == 2


def test_a_stream_opens_again_and_sends_what_has_no_answer(clients, lossy):
    unlucky, lucky = clients
    wanted = [expected(lucky, "qedgix", seed) for seed in range(3)]
    fleets = [unlucky.local_session("qedgix", seed=1), unlucky.local_session("qedgix", seed=2)]
    with unlucky.session("qedgix", seed=0) as session, unlucky.stream() as stream:
        for step in range(SLOTS):
            lossy[0].lose(1)
            for fleet in [session, *fleets]:
                stream.send(fleet, Fleet(step).scene())
            for seed in range(3):
                assert stream.receive().headings.tolist() == wanted[seed][step]
    assert lossy[0].lost == SLOTS


def test_an_upload_whose_answer_is_lost_is_sent_again_from_its_beginning(clients, lossy, tmp_path, capsys):
    unlucky, lucky = clients
    # The two clients of a test are of one kind; each kind has a policy of its own.
    name = f"uploaded-{type(unlucky).__name__.lower()}"
    file = lucky.policies.export("qmix", tmp_path / "qmix.safetensors")
    lossy[1].lose(2)
    uploaded = unlucky.policies.upload(name, file, progress=True)
    assert uploaded.ref == lucky.policies.get(name).ref and uploaded.ref.version == 1
    assert uploaded.ref.digest == lucky.policies.get("qmix").ref.digest
    assert lossy[1].lost == 2 and "100%" in capsys.readouterr().err
    lucky.policies.delete(name)


def test_an_environment_advances_once_per_step(clients, lossy):
    unlucky, lucky = clients
    config = {"uavs": 2, "users": 4, "slots": 5}

    def scenes(client, lose):
        with client.environment(config, seed=3) as environment:
            lossy[0].lose(lose)
            states = [environment.reset()]
            for slot in range(5):
                lossy[0].lose(lose)
                states.append(environment.step([slot, 7 - slot]))
            lossy[0].lose(lose)
        return [state.scenes for state in states]

    assert scenes(unlucky, 1) == scenes(lucky, 0)
    assert lossy[0].lost >= 6


def test_a_submission_whose_answer_is_lost_is_one_job(clients, lossy):
    unlucky, lucky = clients
    # The queue is not touched: the job waits behind the priority of nobody, and is cancelled at once.
    lossy[1].lose(1)
    job = unlucky.jobs.submit(algorithm="vdn", name="lost", training={"steps": 10_000_000}, priority=-100)
    assert [one.id for one in lucky.jobs.list() if one.name == "lost"] == [job.id]
    lossy[1].lose(1)
    job.cancel()
    job.wait(check=False)
    assert job.state == "cancelled"
    lossy[1].lose(1)
    job.delete()
    assert "lost" not in [one.name for one in lucky.jobs.list()]


def test_a_local_session_survives_the_death_of_the_server_and_a_session_does_not(make_server, connect):
    server = make_server().start()
    client = connect(server)
    wanted = expected(client, "qedgix")
    local = client.local_session("qedgix", seed=7)
    session = client.open_session("qedgix", seed=7)
    assert fly(local.act, range(3)) == wanted[:3] == fly(session.act, range(3))
    server.kill()
    hopeless = connect(server, retry=qedgix.Retry(attempts=2, initial=0.001))
    with pytest.raises(qedgix.Unavailable) as failed:
        hopeless.act(Fleet(0).scene(), policy="qedgix")
    assert failed.value.code == "unavailable" and isinstance(failed.value, ConnectionError)
    with pytest.raises(qedgix.Unavailable):
        hopeless.policies.list()
    server.start()
    assert fly(local.act, range(3, SLOTS)) == wanted[3:]
    with pytest.raises(qedgix.NotFound):
        session.act(Fleet(3).scene())
    assert session.step == 3


def test_a_deadline_that_passed_is_an_error_and_the_fleet_stays_in_its_slot(client):
    with client.session("qedgix", seed=7) as session:
        with pytest.raises(qedgix.DeadlineExceeded) as failed:
            session.act(Fleet(0).scene(), timeout=0)
        assert failed.value.code == "deadline_exceeded" and isinstance(failed.value, TimeoutError)
        assert session.step == 0
        assert fly(session.act) == expected(client, "qedgix")


def test_a_busy_server_is_asked_again_when_it_says_so(make_server, connect):
    server = make_server()
    key = server.qedgix("keys", "create", "--name", "slow", "--scopes", "act", "--rate", "50", "--burst", "1").strip()
    server.start()
    client = connect(server, api_key=key)
    local = client.local_session("sweep")
    assert [local.act(Fleet(0).scene()).step for _ in range(2)] == [0, 1]
    impatient = connect(server, api_key=key, retry=qedgix.Retry(attempts=1))
    with pytest.raises(qedgix.ResourceExhausted) as refused:
        for _ in range(10_000):
            impatient.act(Fleet(0).scene(), policy="sweep")
    assert refused.value.code == "resource_exhausted" and refused.value.retry_after >= 1


def test_waits_grow_and_stay_within_the_deadline():
    retry = qedgix.Retry(attempts=4, initial=1.0, maximum=3.0)
    busy = qedgix.ResourceExhausted("busy", code="resource_exhausted", retry_after=5.0)
    lost = qedgix.Unavailable("lost", code="unavailable")
    for attempt, longest in enumerate([1.0, 2.0, 3.0], start=1):
        assert longest / 2 <= retry.wait(lost, attempt, 100.0) <= longest
    assert retry.wait(lost, 4, 100.0) is None
    assert retry.wait(busy, 1, 100.0) == 5.0
    assert retry.wait(busy, 1, 4.0) is None
    for never in (qedgix.InvalidArgument, qedgix.TooLarge, qedgix.NotFound, qedgix.FailedPrecondition, qedgix.Internal):
        assert retry.wait(never("no", code="no"), 1, 100.0) is None
    assert retry.limit(9.0) == 9.0
    assert qedgix.Retry(attempt_timeout=2.0).limit(9.0) == 2.0
