"""The Open Inference Protocol with Triton's own clients, and actions that are those of Act."""

import gzip
import queue
import zlib

import grpc
import httpx
import numpy as np
import pytest
import tritonclient.grpc as triton_grpc
import tritonclient.http as triton_http
from google.protobuf.json_format import MessageToDict
from tritonclient.utils import InferenceServerException, np_to_triton_dtype
from world import GRPC, HTTP, Slot, act_headings, rest

POLICIES = ["qedgix", "qmix", "sweep", "random"]
SLOTS = [Slot(seed) for seed in range(6)]


class OverGrpc:
    """Unary calls."""

    api = triton_grpc

    def __init__(self):
        self.client = triton_grpc.InferenceServerClient(GRPC)

    def inputs(self, tensors):
        made = []
        for name, values in tensors.items():
            values = np.asarray(values)
            made.append(self.api.InferInput(name, list(values.shape), np_to_triton_dtype(values.dtype)))
            self.fill(made[-1], values)
        return made

    def fill(self, made, values):
        made.set_data_from_numpy(values)

    def outputs(self, names):
        return [self.api.InferRequestedOutput(name) for name in names]

    def infer(self, model, tensors, outputs=(), **flags):
        return self.client.infer(model, self.inputs(tensors), outputs=self.outputs(outputs) or None, **flags)

    def close(self):
        self.client.close()


class OverStream(OverGrpc):
    """A stream, on which several requests may be on their way."""

    def __init__(self):
        super().__init__()
        self.answers = queue.Queue()
        self.client.start_stream(lambda result, error: self.answers.put((result, error)))

    def send(self, model, tensors, outputs=(), **flags):
        self.client.async_stream_infer(model, self.inputs(tensors), outputs=self.outputs(outputs) or None, **flags)

    def receive(self):
        result, error = self.answers.get(timeout=60)
        if error is not None:
            raise error
        return result

    def infer(self, model, tensors, outputs=(), **flags):
        self.send(model, tensors, outputs, **flags)
        return self.receive()

    def close(self):
        self.client.stop_stream()
        super().close()


class OverHttp(OverGrpc):
    """Binary tensors."""

    api = triton_http

    def __init__(self):
        self.client = triton_http.InferenceServerClient(HTTP)


class OverJson(OverHttp):
    """Tensors as JSON, both ways."""

    def fill(self, made, values):
        made.set_data_from_numpy(values, binary_data=False)

    def outputs(self, names):
        return [self.api.InferRequestedOutput(name, binary_data=False) for name in names or ["heading_index", "heading_deg"]]


WAYS = [OverGrpc, OverStream, OverHttp, OverJson]


@pytest.fixture(params=WAYS, ids=lambda way: way.__name__)
def way(request):
    opened = request.param()
    yield opened
    opened.close()


@pytest.fixture(params=[OverGrpc, OverHttp], ids=["grpc", "http"])
def client(request):
    opened = request.param()
    yield opened.client
    opened.close()


def headings(result):
    return result.as_numpy("heading_index").tolist()


def flags(step, last, sequence):
    return {"sequence_id": sequence, "sequence_start": step == 0, "sequence_end": step == last}


def test_the_server_tells_of_itself(client):
    assert client.is_server_live()
    assert client.is_server_ready()
    metadata = client.get_server_metadata()
    extensions = metadata["extensions"] if isinstance(metadata, dict) else metadata.extensions
    name = metadata["name"] if isinstance(metadata, dict) else metadata.name
    assert name == "qedgix"
    assert {"sequence", "model_repository", "binary_tensor_data"} <= set(extensions)


def test_models_are_ready_or_not(client):
    assert client.is_model_ready("qedgix")
    assert client.is_model_ready("qedgix", "1")
    assert client.is_model_ready("sweep:1")
    assert not client.is_model_ready("nobody")
    assert not client.is_model_ready("sweep", "77")


def test_metadata_and_configuration():
    grpc = triton_grpc.InferenceServerClient(GRPC).get_model_metadata("qedgix", as_json=True)
    http = triton_http.InferenceServerClient(HTTP).get_model_metadata("qedgix")
    assert (grpc["name"], grpc["platform"]) == ("qedgix", "qedgix")
    # The protocol buffers' JSON writes 64-bit numbers as text.
    as_numbers = [{**tensor, "shape": [int(size) for size in tensor["shape"]]} for tensor in grpc["inputs"] + grpc["outputs"]]
    assert as_numbers == http["inputs"] + http["outputs"]
    shapes = {tensor["name"]: (tensor["datatype"], tensor["shape"]) for tensor in as_numbers}
    assert shapes["heading_index"][0] == "INT32"
    assert shapes["user_aoi"][0] == "FP32" and len(shapes["user_aoi"][1]) == 1
    assert shapes["edge_index"] == ("INT64", [-1, 2])
    config = triton_http.InferenceServerClient(HTTP).get_model_config("sweep")
    assert config["max_batch_size"] == 0 and config["sequence_batching"]["max_sequence_idle_microseconds"] > 0
    over_grpc = triton_grpc.InferenceServerClient(GRPC).get_model_config("sweep").config
    assert [i.name for i in over_grpc.input] == [i["name"] for i in config["input"]]
    assert over_grpc.sequence_batching.max_sequence_idle_microseconds > 0


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("form", ["scene", "graph"])
def test_sequences_fly_as_sessions_of_act_do(way, policy, form):
    expected, values = act_headings(policy, SLOTS, form=form)
    last = len(SLOTS) - 1
    for step, slot in enumerate(SLOTS):
        tensors = slot.scene_tensors() if form == "scene" else slot.graph_tensors()
        parameters = {"seed": 7, "step": 0} if step == 0 else {"step": step}
        asked = ["heading_index", "heading_deg", "q_values"]
        result = way.infer(policy, tensors, asked, request_id=f"r-{step}", parameters=parameters, **flags(step, last, 41))
        assert headings(result) == expected[step], f"step {step}"
        degrees = result.as_numpy("heading_deg")
        assert degrees.tolist() == [45.0 * h if h < 8 else None for h in expected[step]]
        assert degrees.dtype == np.float32
        if policy in ("qedgix", "qmix"):
            assert np.array_equal(result.as_numpy("q_values"), np.array(values[step], dtype=np.float32))
        else:
            assert np.isnan(result.as_numpy("q_values")).all()
        response = result.get_response()
        told = response["id"] if isinstance(response, dict) else response.id
        assert told == f"r-{step}"


def test_number_and_text_are_two_sequences(way):
    expected, _ = act_headings("qedgix", SLOTS[:3])
    for step, slot in enumerate(SLOTS[:3]):
        for sequence in (5, "5"):
            parameters = {"seed": 7} if step == 0 else None
            result = way.infer("qedgix", slot.scene_tensors(), parameters=parameters, **flags(step, 2, sequence))
            assert headings(result) == expected[step]
    with pytest.raises(InferenceServerException, match="sequence 5 of qedgix"):
        way.infer("qedgix", SLOTS[0].scene_tensors(), **flags(1, 2, 5))


def test_a_retry_advances_nothing(way):
    expected, _ = act_headings("qedgix", SLOTS)
    last = len(SLOTS) - 1
    for step, slot in enumerate(SLOTS):
        parameters = {"step": step, "seed": 7} if step == 0 else {"step": step}
        for _ in range(2):
            result = way.infer("qedgix", slot.scene_tensors(), parameters=parameters, **flags(step, last, "again"))
            assert headings(result) == expected[step]
    with pytest.raises(InferenceServerException, match='sequence "again" of qedgix'):
        way.infer("qedgix", SLOTS[0].scene_tensors(), parameters={"step": 6}, **flags(1, last, "again"))


def test_a_start_starts_over(way):
    expected, _ = act_headings("sweep", SLOTS[:2], seed=3)
    for _ in range(2):
        for step, slot in enumerate(SLOTS[:2]):
            parameters = {"seed": 3} if step == 0 else None
            result = way.infer("sweep", slot.scene_tensors(), parameters=parameters, **flags(step, 9, "over"))
            assert headings(result) == expected[step]


def test_memory_that_the_caller_keeps(way):
    expected, _ = act_headings("qedgix", SLOTS)
    state = None
    for step, slot in enumerate(SLOTS):
        tensors = slot.scene_tensors()
        if state is not None:
            tensors["recurrent_state"] = state
        result = way.infer("qedgix", tensors, ["heading_index", "recurrent_state"], parameters={"seed": 7})
        assert headings(result) == expected[step], f"step {step}"
        state = result.as_numpy("recurrent_state").astype(np.object_)
        assert state.shape == (1,)


def test_ids_and_datatypes(way):
    slot = Slot(9)
    ids = {"uav_ids": np.array([b"c", b"a", b"b"], dtype=np.object_)}
    wide = {name: values.astype(np.float64) for name, values in slot.scene_tensors().items()}
    result = way.infer("sweep", {**wide, **ids})
    scene = slot.scene()
    for uav, name in zip(scene["uavs"], "cab"):
        uav["id"] = name
    actions = rest("/v1/act", {"policy": "sweep", "scene": scene})["actions"]
    assert headings(result) == [action["heading_index"] for action in actions]


def test_a_stream_keeps_the_order_and_goes_on_after_an_error():
    stream = OverStream()
    expected, _ = act_headings("qedgix", SLOTS)
    last = len(SLOTS) - 1
    for step, slot in enumerate(SLOTS):
        # Nobody waits for an answer before the next slot.
        for sequence in ("one", "two"):
            parameters = {"seed": 7} if step == 0 else None
            stream.send("qedgix", slot.scene_tensors(), parameters=parameters, **flags(step, last, sequence))
        stream.send("nobody", slot.scene_tensors())
    for step in range(len(SLOTS)):
        assert headings(stream.receive()) == expected[step]
        assert headings(stream.receive()) == expected[step]
        with pytest.raises(InferenceServerException, match='no model "nobody"'):
            stream.receive()
    stream.close()


def test_what_is_wrong_is_named(way):
    good = SLOTS[0].scene_tensors()
    lacking = {name: values for name, values in good.items() if name != "user_aoi"}
    cases = [
        ("nobody", good, {}, 'no model "nobody"'),
        ("qedgix", lacking, {}, "user_aoi: "),
        ("qedgix", {**good, "users": good["user_aoi"]}, {}, r"inputs\[3\].name: "),
        ("qedgix", {**good, "user_aoi": good["user_aoi"][:4]}, {}, "user_positions.shape: "),
        ("qedgix", {**good, "user_aoi": -good["user_aoi"] - 1}, {}, r"user_aoi\[0\]: "),
        ("qedgix", {**good, "uav_positions": good["uav_positions"].astype(np.int32)}, {}, "uav_positions.datatype: "),
        ("qedgix", good, {"outputs": ["headings"]}, r"outputs\[0\].name: "),
        ("qedgix", good, {"parameters": {"stop": 1}}, "parameters: "),
        ("qedgix", good, {"model_version": "9"}, "model qedgix has no version 9"),
    ]
    for model, tensors, more, message in cases:
        with pytest.raises(InferenceServerException, match=message):
            way.infer(model, tensors, **more)
    assert way.infer("qedgix", good).as_numpy("heading_index").shape == (3,)


def test_models_are_unloaded_and_loaded(client):
    way = OverGrpc()
    tensors = SLOTS[0].scene_tensors()

    def states():
        index = client.get_model_repository_index()
        entries = index if isinstance(index, list) else [{"name": m.name, "version": m.version, "state": m.state} for m in index.models]
        return {(entry["name"], entry["version"]): entry["state"] for entry in entries}

    assert states()["nearest", "1"] == "READY"
    expected, _ = act_headings("nearest", SLOTS[:2])
    assert headings(way.infer("nearest", tensors, parameters={"seed": 7}, **flags(0, 1, 77))) == expected[0]
    client.unload_model("nearest")
    try:
        assert states()["nearest", "1"] == "UNAVAILABLE"
        assert states()["sweep", "1"] == "READY"
        assert not client.is_model_ready("nearest")
        with pytest.raises(InferenceServerException, match='is unloaded'):
            way.infer("nearest", tensors)
        with pytest.raises(InferenceServerException, match='is unloaded'):
            client.get_model_metadata("nearest")
        # What is under way goes on.
        assert headings(way.infer("nearest", SLOTS[1].scene_tensors(), **flags(1, 1, 77))) == expected[1]
    finally:
        client.load_model("nearest")
    assert states()["nearest", "1"] == "READY"
    assert client.is_model_ready("nearest")
    assert headings(way.infer("nearest", tensors, parameters={"seed": 7})) == expected[0]
    for call in (client.load_model, client.unload_model):
        with pytest.raises(InferenceServerException, match='no model "nobody"'):
            call("nobody")
    way.close()


def statistics(client, *model):
    """The statistics of a client as nested dictionaries with whole numbers, by name and version."""
    told = client.get_inference_statistics(*model)
    if not isinstance(told, dict):
        told = MessageToDict(told, preserving_proto_field_name=True)

    def as_numbers(value):
        if isinstance(value, dict):
            return {key: as_numbers(inner) if key != "name" else inner for key, inner in value.items()}
        if isinstance(value, list):
            return [as_numbers(inner) for inner in value]
        return int(value) if isinstance(value, str) and value.isdigit() else value

    return {(model["name"], model["version"]): model for model in as_numbers(told)["model_stats"]}


def test_statistics_count_what_was_computed(client):
    way = OverGrpc()
    before = statistics(client, "max-aoi").get(("max-aoi", 1), {})
    for step, slot in enumerate(SLOTS):
        way.infer("max-aoi", slot.scene_tensors(), **flags(step, len(SLOTS) - 1, 301))
    with pytest.raises(InferenceServerException):
        way.infer("max-aoi", {"user_aoi": SLOTS[0].aoi})
    rest("/v1/act", {"policy": "max-aoi", "scene": SLOTS[0].scene()})
    after = statistics(client, "max-aoi", "1")["max-aoi", 1]
    # Every protocol counts; a request that does not become a slot of a fleet does not.
    count = len(SLOTS) + 1
    grown = lambda *path: pick(after, path) - pick(before, path)
    assert grown("inference_count") == count
    assert 1 <= grown("execution_count") <= count
    for name in ("success", "queue", "compute_input", "compute_infer", "compute_output"):
        assert grown("inference_stats", name, "count") == count, name
    assert grown("inference_stats", "success", "ns") >= grown("inference_stats", "compute_infer", "ns") > 0
    assert grown("inference_stats", "fail", "count") == 0
    batches = lambda told: sum(pick(batch, ["compute_infer", "count"]) for batch in told.get("batch_stats", []))
    assert batches(after) - batches(before) == grown("execution_count")
    assert after["last_inference"] > 1_700_000_000_000
    everything = statistics(client)
    assert everything["max-aoi", 1]["inference_count"] >= after["inference_count"]
    assert ("qedgix", 1) in everything
    for unknown, message in (("nobody",), 'no model "nobody"'), (("max-aoi", "9"), "model max-aoi has no version 9"):
        with pytest.raises(InferenceServerException, match=message):
            client.get_inference_statistics(*unknown)
    way.close()


def pick(told, path):
    """A number in nested dictionaries, in which protocol buffers leave out zeros."""
    for name in path:
        told = told.get(name, {})
    return told or 0


def test_settings_are_told_and_not_changed(client):
    traces, logs = client.get_trace_settings(), client.get_log_settings()
    if not isinstance(traces, dict):
        traces = {name: list(setting.value) for name, setting in traces.settings.items()}
        logs = {name: getattr(s, s.WhichOneof("parameter_choice")) for name, s in logs.settings.items()}
    assert traces["trace_level"] == ["OFF"]
    assert logs["log_error"] is True and logs["log_file"] == ""
    assert client.get_trace_settings("qedgix") == client.get_trace_settings()
    # What is so already, and the default.
    client.update_trace_settings(settings={"trace_level": ["OFF"], "trace_file": None})
    client.update_log_settings({"log_error": True, "log_verbose_level": logs["log_verbose_level"], "log_file": None})
    with pytest.raises(InferenceServerException, match="settings.trace_level: "):
        client.update_trace_settings(settings={"trace_level": ["TIMESTAMPS"]})
    with pytest.raises(InferenceServerException, match="settings: .*trace_colour"):
        client.update_trace_settings(settings={"trace_colour": "red"})
    with pytest.raises(InferenceServerException, match="no model"):
        client.update_trace_settings("nobody", settings={"trace_level": ["OFF"]})
    with pytest.raises(InferenceServerException, match="settings.log_error: "):
        client.update_log_settings({"log_error": False})
    with pytest.raises(InferenceServerException, match="settings.log_file: "):
        client.update_log_settings({"log_file": "/tmp/server.log"})


def test_there_is_no_shared_memory(client):
    for kind, arguments in (("system", ("/key", 64)), ("cuda", (b"aGFuZGxl", 0, 64))):
        status = getattr(client, f"get_{kind}_shared_memory_status")
        regions = status()
        assert not (regions if isinstance(regions, list) else regions.regions)
        with pytest.raises(InferenceServerException, match='no region of shared memory "mine"'):
            status("mine")
        with pytest.raises(InferenceServerException, match="name: .*not supported"):
            getattr(client, f"register_{kind}_shared_memory")("mine", *arguments)
        # Tools begin with this.
        getattr(client, f"unregister_{kind}_shared_memory")()


@pytest.mark.parametrize("encoding", ["gzip", "deflate"])
def test_compressed_requests_are_answered_alike(encoding):
    slot = Slot(12, uavs=40, users=200)
    plain = OverHttp().infer("sweep", slot.scene_tensors())
    over_grpc = OverGrpc()
    over_http = OverHttp()
    algorithms = {"request_compression_algorithm": encoding, "response_compression_algorithm": encoding}
    answers = [
        over_grpc.infer("sweep", slot.scene_tensors(), compression_algorithm=encoding),
        over_http.infer("sweep", slot.scene_tensors(), **algorithms),
        OverJson().infer("sweep", slot.scene_tensors(), **algorithms),
    ]
    for answer in answers:
        assert headings(answer) == headings(plain)
    assert answers[1].get_response()["model_name"] == "sweep"
    stream = triton_grpc.InferenceServerClient(GRPC)
    received = queue.Queue()
    stream.start_stream(lambda result, error: received.put((result, error)), compression_algorithm=encoding)
    for _ in range(3):
        stream.async_stream_infer("sweep", over_grpc.inputs(slot.scene_tensors()))
    for _ in range(3):
        result, error = received.get(timeout=60)
        assert error is None and headings(result) == headings(plain)
    stream.stop_stream()


def test_what_inflates_beyond_the_limit_is_refused():
    # 24 MiB of spaces in 24 KiB.
    bomb = {"gzip": gzip.compress(b" " * (24 << 20)), "deflate": zlib.compress(b" " * (24 << 20))}
    for encoding, body in bomb.items():
        headers = {"content-encoding": encoding, "content-type": "application/json"}
        answer = httpx.post(f"http://{HTTP}/v2/models/sweep/infer", content=body, headers=headers)
        assert (answer.status_code, answer.json()["code"]) == (413, "too_large")
        # Other routes, and other encodings, take no compressed bodies.
        assert httpx.post(f"http://{HTTP}/v1/act", content=body, headers=headers).status_code == 415
    headers = {"content-encoding": "br", "content-type": "application/json"}
    assert httpx.post(f"http://{HTTP}/v2/models/sweep/infer", content=b"x", headers=headers).status_code == 415
    headers = {"content-encoding": "gzip", "content-type": "application/json"}
    answer = httpx.post(f"http://{HTTP}/v2/models/sweep/infer", content=b"not gzip", headers=headers)
    assert (answer.status_code, answer.json()["code"], answer.json()["field"]) == (400, "invalid_argument", "body")
    with grpc.insecure_channel(GRPC) as channel:
        for algorithm in (grpc.Compression.Gzip, grpc.Compression.Deflate):
            call = channel.unary_unary("/inference.GRPCInferenceService/ModelInfer")
            with pytest.raises(grpc.RpcError) as refused:
                call(b"\x0a\x00" * (12 << 20), timeout=60, compression=algorithm)
            assert refused.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
            call = channel.unary_unary("/qedgix.v1.PolicyService/Act")
            with pytest.raises(grpc.RpcError) as refused:
                call(b"\x0a\x00" * 1000, timeout=60, compression=algorithm)
            assert refused.value.code() == grpc.StatusCode.UNIMPLEMENTED


SEQUENCES = 48
LOADED = [Slot(100 + step, uavs=4, users=9) for step in range(6)]


def loaded(sequence, step):
    """Arguments of one request of the load."""
    return {"request_id": f"{sequence}/{step}", "parameters": {"step": step, "seed": 7} if step == 0 else {"step": step}}


def test_load_over_grpc_as_perf_analyzer_makes_it():
    expected, _ = act_headings("qedgix", LOADED)
    way, received = OverGrpc(), queue.Queue()
    last = len(LOADED) - 1
    before = statistics(way.client, "qedgix", "1")["qedgix", 1]
    sent = [way.inputs(slot.scene_tensors()) for slot in LOADED]

    def send(sequence, step):
        done = lambda result, error: received.put((sequence, step, result, error))
        more = {**loaded(sequence, step), **flags(step, last, 1000 + sequence)}
        way.client.async_infer("qedgix", sent[step], done, **more)

    for sequence in range(SEQUENCES):
        send(sequence, 0)
    for _ in range(SEQUENCES * len(LOADED)):
        sequence, step, result, error = received.get(timeout=60)
        assert error is None, error
        assert headings(result) == expected[step], f"sequence {sequence}, step {step}"
        if step < last:
            send(sequence, step + 1)
    after = statistics(way.client, "qedgix", "1")["qedgix", 1]
    assert after["inference_count"] - before.get("inference_count", 0) >= SEQUENCES * len(LOADED)
    assert after["execution_count"] <= after["inference_count"]
    way.close()


def test_load_over_http_as_perf_analyzer_makes_it():
    expected, _ = act_headings("qedgix", LOADED)
    way = OverHttp()
    client = triton_http.InferenceServerClient(HTTP, concurrency=16)
    last = len(LOADED) - 1
    sent = [way.inputs(slot.scene_tensors()) for slot in LOADED]
    for step in range(len(LOADED)):
        more = lambda sequence: {**loaded(sequence, step), **flags(step, last, 2000 + sequence)}
        answers = [client.async_infer("qedgix", sent[step], **more(sequence)) for sequence in range(SEQUENCES)]
        for sequence, answer in enumerate(answers):
            assert headings(answer.get_result()) == expected[step], f"sequence {sequence}, step {step}"
    client.close()
