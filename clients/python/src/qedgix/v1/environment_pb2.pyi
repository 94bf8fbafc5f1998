import datetime

from google.protobuf import duration_pb2 as _duration_pb2
from google.protobuf import struct_pb2 as _struct_pb2
from google.protobuf import timestamp_pb2 as _timestamp_pb2
from qedgix.v1 import policy_pb2 as _policy_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class CreateEnvironmentRequest(_message.Message):
    __slots__ = ("environment", "seed", "count", "auto_reset", "environment_id")
    ENVIRONMENT_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    AUTO_RESET_FIELD_NUMBER: _ClassVar[int]
    ENVIRONMENT_ID_FIELD_NUMBER: _ClassVar[int]
    environment: _struct_pb2.Struct
    seed: int
    count: int
    auto_reset: bool
    environment_id: str
    def __init__(self, environment: _Optional[_Union[_struct_pb2.Struct, _Mapping]] = ..., seed: _Optional[int] = ..., count: _Optional[int] = ..., auto_reset: bool = ..., environment_id: _Optional[str] = ...) -> None: ...

class Environment(_message.Message):
    __slots__ = ("environment_id", "environment", "seed", "count", "auto_reset", "headings", "episode", "slot", "step", "created_at", "ttl", "owner")
    ENVIRONMENT_ID_FIELD_NUMBER: _ClassVar[int]
    ENVIRONMENT_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    AUTO_RESET_FIELD_NUMBER: _ClassVar[int]
    HEADINGS_FIELD_NUMBER: _ClassVar[int]
    EPISODE_FIELD_NUMBER: _ClassVar[int]
    SLOT_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    CREATED_AT_FIELD_NUMBER: _ClassVar[int]
    TTL_FIELD_NUMBER: _ClassVar[int]
    OWNER_FIELD_NUMBER: _ClassVar[int]
    environment_id: str
    environment: _struct_pb2.Struct
    seed: int
    count: int
    auto_reset: bool
    headings: int
    episode: int
    slot: int
    step: int
    created_at: _timestamp_pb2.Timestamp
    ttl: _duration_pb2.Duration
    owner: str
    def __init__(self, environment_id: _Optional[str] = ..., environment: _Optional[_Union[_struct_pb2.Struct, _Mapping]] = ..., seed: _Optional[int] = ..., count: _Optional[int] = ..., auto_reset: bool = ..., headings: _Optional[int] = ..., episode: _Optional[int] = ..., slot: _Optional[int] = ..., step: _Optional[int] = ..., created_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., ttl: _Optional[_Union[datetime.timedelta, _duration_pb2.Duration, _Mapping]] = ..., owner: _Optional[str] = ...) -> None: ...

class ResetRequest(_message.Message):
    __slots__ = ("environment_id", "seed", "episode", "return_graph")
    ENVIRONMENT_ID_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    EPISODE_FIELD_NUMBER: _ClassVar[int]
    RETURN_GRAPH_FIELD_NUMBER: _ClassVar[int]
    environment_id: str
    seed: int
    episode: int
    return_graph: bool
    def __init__(self, environment_id: _Optional[str] = ..., seed: _Optional[int] = ..., episode: _Optional[int] = ..., return_graph: bool = ...) -> None: ...

class StepRequest(_message.Message):
    __slots__ = ("environment_id", "actions", "step", "return_graph")
    ENVIRONMENT_ID_FIELD_NUMBER: _ClassVar[int]
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    RETURN_GRAPH_FIELD_NUMBER: _ClassVar[int]
    environment_id: str
    actions: _containers.RepeatedCompositeFieldContainer[Headings]
    step: int
    return_graph: bool
    def __init__(self, environment_id: _Optional[str] = ..., actions: _Optional[_Iterable[_Union[Headings, _Mapping]]] = ..., step: _Optional[int] = ..., return_graph: bool = ...) -> None: ...

class Headings(_message.Message):
    __slots__ = ("headings",)
    HEADINGS_FIELD_NUMBER: _ClassVar[int]
    headings: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, headings: _Optional[_Iterable[int]] = ...) -> None: ...

class EnvironmentState(_message.Message):
    __slots__ = ("environment_id", "step", "episode", "slot", "copies")
    ENVIRONMENT_ID_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    EPISODE_FIELD_NUMBER: _ClassVar[int]
    SLOT_FIELD_NUMBER: _ClassVar[int]
    COPIES_FIELD_NUMBER: _ClassVar[int]
    environment_id: str
    step: int
    episode: int
    slot: int
    copies: _containers.RepeatedCompositeFieldContainer[CopyState]
    def __init__(self, environment_id: _Optional[str] = ..., step: _Optional[int] = ..., episode: _Optional[int] = ..., slot: _Optional[int] = ..., copies: _Optional[_Iterable[_Union[CopyState, _Mapping]]] = ...) -> None: ...

class CopyState(_message.Message):
    __slots__ = ("scene", "graph", "reward", "truncated", "seed", "finished")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    GRAPH_FIELD_NUMBER: _ClassVar[int]
    REWARD_FIELD_NUMBER: _ClassVar[int]
    TRUNCATED_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    FINISHED_FIELD_NUMBER: _ClassVar[int]
    scene: _policy_pb2.Scene
    graph: _policy_pb2.Graph
    reward: float
    truncated: bool
    seed: int
    finished: FinishedEpisode
    def __init__(self, scene: _Optional[_Union[_policy_pb2.Scene, _Mapping]] = ..., graph: _Optional[_Union[_policy_pb2.Graph, _Mapping]] = ..., reward: _Optional[float] = ..., truncated: bool = ..., seed: _Optional[int] = ..., finished: _Optional[_Union[FinishedEpisode, _Mapping]] = ...) -> None: ...

class FinishedEpisode(_message.Message):
    __slots__ = ("seed", "metrics", "scene", "graph")
    SEED_FIELD_NUMBER: _ClassVar[int]
    METRICS_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    GRAPH_FIELD_NUMBER: _ClassVar[int]
    seed: int
    metrics: EpisodeMetrics
    scene: _policy_pb2.Scene
    graph: _policy_pb2.Graph
    def __init__(self, seed: _Optional[int] = ..., metrics: _Optional[_Union[EpisodeMetrics, _Mapping]] = ..., scene: _Optional[_Union[_policy_pb2.Scene, _Mapping]] = ..., graph: _Optional[_Union[_policy_pb2.Graph, _Mapping]] = ...) -> None: ...

class EpisodeMetrics(_message.Message):
    __slots__ = ("mean_aoi", "peak_aoi", "p95_aoi", "coverage", "fairness")
    MEAN_AOI_FIELD_NUMBER: _ClassVar[int]
    PEAK_AOI_FIELD_NUMBER: _ClassVar[int]
    P95_AOI_FIELD_NUMBER: _ClassVar[int]
    COVERAGE_FIELD_NUMBER: _ClassVar[int]
    FAIRNESS_FIELD_NUMBER: _ClassVar[int]
    mean_aoi: float
    peak_aoi: float
    p95_aoi: float
    coverage: float
    fairness: float
    def __init__(self, mean_aoi: _Optional[float] = ..., peak_aoi: _Optional[float] = ..., p95_aoi: _Optional[float] = ..., coverage: _Optional[float] = ..., fairness: _Optional[float] = ...) -> None: ...

class GetEnvironmentRequest(_message.Message):
    __slots__ = ("environment_id",)
    ENVIRONMENT_ID_FIELD_NUMBER: _ClassVar[int]
    environment_id: str
    def __init__(self, environment_id: _Optional[str] = ...) -> None: ...

class DeleteEnvironmentRequest(_message.Message):
    __slots__ = ("environment_id",)
    ENVIRONMENT_ID_FIELD_NUMBER: _ClassVar[int]
    environment_id: str
    def __init__(self, environment_id: _Optional[str] = ...) -> None: ...
