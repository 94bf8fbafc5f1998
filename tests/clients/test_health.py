"""`grpc.health.v1` with the client of grpcio-health-checking."""

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from world import GRPC

SERVICES = [
    "",
    "qedgix.v1.PolicyService",
    "qedgix.v1.EnvironmentService",
    "qedgix.v1.JobService",
    "inference.GRPCInferenceService",
]
STATUS = health_pb2.HealthCheckResponse


@pytest.fixture
def stub():
    with grpc.insecure_channel(GRPC) as channel:
        yield health_pb2_grpc.HealthStub(channel)


def ask(service):
    return health_pb2.HealthCheckRequest(service=service)


@pytest.mark.parametrize("service", SERVICES)
def test_check_of_a_known_service(stub, service):
    assert stub.Check(ask(service), timeout=60).status == STATUS.SERVING


def test_check_of_an_unknown_service(stub):
    with pytest.raises(grpc.RpcError) as refused:
        stub.Check(ask("no.such.Service"), timeout=60)
    assert refused.value.code() == grpc.StatusCode.NOT_FOUND


@pytest.mark.parametrize("service", SERVICES)
def test_watch_of_a_known_service(stub, service):
    watch = stub.Watch(ask(service), timeout=60)
    assert next(watch).status == STATUS.SERVING
    watch.cancel()


def test_watch_of_an_unknown_service_stays_open(stub):
    watch = stub.Watch(ask("no.such.Service"), timeout=3)
    assert next(watch).status == STATUS.SERVICE_UNKNOWN
    # Nothing changes, so the next thing that happens is that the caller's own patience ends.
    with pytest.raises(grpc.RpcError) as ended:
        next(watch)
    assert ended.value.code() == grpc.StatusCode.DEADLINE_EXCEEDED
