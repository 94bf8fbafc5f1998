"""Every error code has a class, over both transports, and settings are checked."""

from __future__ import annotations

import re

import pytest
import trustme
from conftest import ROOT
from test_act import Fleet

import qedgix
from qedgix import errors

CODES = re.findall(r"^\| `(\w+)` \| (\d+) \| (\w*) \|", (ROOT / "docs" / "errors.md").read_text(), re.MULTILINE)
STATUS = {
    "INVALID_ARGUMENT": (3, qedgix.InvalidArgument),
    "UNIMPLEMENTED": (12, qedgix.InvalidArgument),
    "RESOURCE_EXHAUSTED": (8, qedgix.ResourceExhausted),
    "UNAUTHENTICATED": (16, qedgix.Unauthenticated),
    "PERMISSION_DENIED": (7, qedgix.PermissionDenied),
    "NOT_FOUND": (5, qedgix.NotFound),
    "": (12, qedgix.InvalidArgument),
    "ALREADY_EXISTS": (6, qedgix.AlreadyExists),
    "FAILED_PRECONDITION": (9, qedgix.FailedPrecondition),
    "DEADLINE_EXCEEDED": (4, qedgix.DeadlineExceeded),
    "UNAVAILABLE": (14, qedgix.Unavailable),
    "INTERNAL": (13, qedgix.Internal),
}


@pytest.mark.parametrize(("code", "http", "grpc"), CODES)
def test_every_documented_code_has_the_class_of_its_family(code, http, grpc):
    import httpx

    status, kind = STATUS[grpc]
    kind = qedgix.TooLarge if code == "too_large" else kind
    assert errors.family(code, status) is kind
    error = errors.from_http(httpx.Response(int(http), json={"code": code, "detail": "why"}))
    assert type(error) is kind and error.code == code and str(error) == f"why ({code})"


def test_the_documentation_has_codes():
    assert len(CODES) > 25


def test_answers_of_something_else_have_a_class():
    import httpx

    for status, kind in [(404, qedgix.NotFound), (502, qedgix.Unavailable), (413, qedgix.TooLarge), (500, qedgix.Internal)]:
        error = errors.from_http(httpx.Response(status, text="<html>"))
        assert type(error) is kind


def test_keys_and_scopes(make_server, connect, monkeypatch):
    server = make_server()
    key = server.qedgix("keys", "create", "--name", "reader", "--scopes", "read").strip()
    server.start()
    monkeypatch.delenv("QEDGIX_API_KEY", raising=False)
    stranger, reader = connect(server), connect(server, api_key=key)
    for call in (stranger.policies.list, stranger.list_sessions):
        with pytest.raises(qedgix.Unauthenticated) as refused:
            call()
        assert refused.value.code == "unauthenticated"
    assert reader.list_sessions() == [] and reader.policies.get("sweep").kind == "baseline"
    with pytest.raises(qedgix.PermissionDenied) as refused:
        reader.act(Fleet(0).scene(), policy="sweep")
    assert (refused.value.code, refused.value.required_scope) == ("permission_denied", "act")
    with pytest.raises(qedgix.PermissionDenied) as refused:
        reader.jobs.submit()
    assert refused.value.required_scope == "jobs"
    monkeypatch.setenv("QEDGIX_API_KEY", key)
    assert connect(server).list_sessions() == []


def test_tls_and_client_certificates(make_server, connect, tmp_path):
    authority = trustme.CA()
    authority.cert_pem.write_to_path(tmp_path / "ca.pem")
    for name, made in (("server", authority.issue_cert("127.0.0.1")), ("client", authority.issue_cert("caller"))):
        made.private_key_pem.write_to_path(tmp_path / f"{name}.key")
        for i, pem in enumerate(made.cert_chain_pems):
            pem.write_to_path(tmp_path / f"{name}.pem", append=i > 0)
    files = {name: str(tmp_path / name) for name in ("ca.pem", "server.pem", "server.key", "client.pem", "client.key")}
    flags = ["--tls-cert", files["server.pem"], "--tls-key", files["server.key"], "--tls-client-ca", files["ca.pem"]]
    server = make_server(*flags).start()
    certificate = {"client_cert": files["client.pem"], "client_key": files["client.key"]}
    trusted = connect(server, ca_cert=files["ca.pem"], **certificate)
    assert trusted.act(Fleet(0).scene(), policy="sweep").step == 0
    assert trusted.policies.get("sweep").headings == 8
    once = qedgix.Retry(attempts=1)
    for client in (connect(server, retry=once), connect(server, ca_cert=files["ca.pem"], retry=once)):
        with pytest.raises(qedgix.Unavailable):
            client.list_sessions()
        with pytest.raises(qedgix.Unavailable):
            client.policies.list()


def test_exchanged_addresses_are_told_and_not_tried_again(server, connect):
    client = connect(server.http, server.grpc, retry=qedgix.Retry(initial=30.0))
    fleet, scene = client.local_session("sweep"), Fleet(0).scene()
    with client.stream() as stream:
        for call in (client.list_sessions, lambda: fleet.act(scene), lambda: stream.act(fleet, scene)):
            with pytest.raises(qedgix.InvalidArgument, match="this is that of REST") as refused:
                call()
            assert (refused.value.field, refused.value.value) == ("grpc", server.http)
    for call in (client.policies.list, lambda: client.jobs.submit(), lambda: client.jobs.get("job")):
        with pytest.raises(qedgix.InvalidArgument, match="this is that of gRPC") as refused:
            call()
        assert (refused.value.field, refused.value.value) == ("http", server.grpc)


def test_an_address_without_a_server_is_in_the_message(connect):
    client = connect("127.0.0.1:1", "127.0.0.1:2", retry=qedgix.Retry(attempts=1))
    with pytest.raises(qedgix.Unavailable, match=r"gRPC at 127\.0\.0\.1:1 \(`grpc` of the client\)"):
        client.list_sessions()
    with pytest.raises(qedgix.Unavailable, match=r"REST at 127\.0\.0\.1:2 \(`http` of the client\)"):
        client.policies.list()


@pytest.mark.parametrize("address", ["", "host", "host:port", "ftp://host:1", "http://host:1/path", "http://:1", "a b:1:2"])
def test_addresses_are_checked(connect, address):
    for addresses, field in (((address, "h:1"), "grpc"), (("h:1", address), "http")):
        with pytest.raises(qedgix.InvalidArgument) as refused:
            connect(*addresses)
        assert refused.value.field == field
    with pytest.raises(qedgix.InvalidArgument) as refused:
        connect("h:1", 8080)
    assert (refused.value.field, refused.value.value) == ("http", "8080")


def test_half_a_client_certificate_is_refused(connect):
    with pytest.raises(qedgix.InvalidArgument) as refused:
        connect("h:1", client_cert="cert.pem")
    assert refused.value.field == "client_cert"


def test_a_key_that_others_can_read_on_its_way_is_warned_of(connect):
    with pytest.warns(UserWarning):
        connect("example.org:1", api_key="qdx_a_b")
    connect("https://example.org:1", "https://example.org:2", api_key="qdx_a_b")
    connect("localhost:1", "[::1]:2", api_key="qdx_a_b")


def test_the_data_directory_tells_the_addresses(server, tmp_path):
    with qedgix.Client.of_data_dir(server.data_dir) as client:
        assert client.policies.get("sweep").ref.version == 1
    with pytest.raises(FileNotFoundError):
        qedgix.Client.of_data_dir(tmp_path)
