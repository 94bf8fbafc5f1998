"""The Open Inference Protocol with Triton's own clients, and actions that are those of Act."""

import queue

import numpy as np
import pytest
import tritonclient.grpc as triton_grpc
import tritonclient.http as triton_http
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
        ("qedgix", good, {"model_version": "9"}, 'no model "qedgix:9"'),
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
