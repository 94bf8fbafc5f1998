import datetime

from google.protobuf import duration_pb2 as _duration_pb2
from google.protobuf import struct_pb2 as _struct_pb2
from google.protobuf import timestamp_pb2 as _timestamp_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Constraint(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CONSTRAINT_UNSPECIFIED: _ClassVar[Constraint]
    CONSTRAINT_NO_FLY: _ClassVar[Constraint]
    CONSTRAINT_MIN_SEPARATION: _ClassVar[Constraint]
    CONSTRAINT_MAX_DISTANCE: _ClassVar[Constraint]
    CONSTRAINT_RETURN_IN_TIME: _ClassVar[Constraint]

class Boundary(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    BOUNDARY_UNSPECIFIED: _ClassVar[Boundary]
    BOUNDARY_CLAMP: _ClassVar[Boundary]
    BOUNDARY_FREE: _ClassVar[Boundary]

class NodeKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    NODE_KIND_UNSPECIFIED: _ClassVar[NodeKind]
    NODE_KIND_UAV: _ClassVar[NodeKind]
    NODE_KIND_USER: _ClassVar[NodeKind]

class PolicyKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    POLICY_KIND_UNSPECIFIED: _ClassVar[PolicyKind]
    POLICY_KIND_CHECKPOINT: _ClassVar[PolicyKind]
    POLICY_KIND_BASELINE: _ClassVar[PolicyKind]

class Needs(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    NEEDS_UNSPECIFIED: _ClassVar[Needs]
    NEEDS_DETECTIONS: _ClassVar[Needs]
    NEEDS_OWN_POSITIONS: _ClassVar[Needs]
    NEEDS_FULL_SCENE: _ClassVar[Needs]
CONSTRAINT_UNSPECIFIED: Constraint
CONSTRAINT_NO_FLY: Constraint
CONSTRAINT_MIN_SEPARATION: Constraint
CONSTRAINT_MAX_DISTANCE: Constraint
CONSTRAINT_RETURN_IN_TIME: Constraint
BOUNDARY_UNSPECIFIED: Boundary
BOUNDARY_CLAMP: Boundary
BOUNDARY_FREE: Boundary
NODE_KIND_UNSPECIFIED: NodeKind
NODE_KIND_UAV: NodeKind
NODE_KIND_USER: NodeKind
POLICY_KIND_UNSPECIFIED: PolicyKind
POLICY_KIND_CHECKPOINT: PolicyKind
POLICY_KIND_BASELINE: PolicyKind
NEEDS_UNSPECIFIED: Needs
NEEDS_DETECTIONS: Needs
NEEDS_OWN_POSITIONS: Needs
NEEDS_FULL_SCENE: Needs

class ActRequest(_message.Message):
    __slots__ = ("policy", "graph", "scene", "session_id", "recurrent_state", "step", "run_id", "return_q_values", "seed", "symmetric", "frame", "world", "return_velocity", "return_waypoint", "constraints", "explain")
    POLICY_FIELD_NUMBER: _ClassVar[int]
    GRAPH_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    RECURRENT_STATE_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    RUN_ID_FIELD_NUMBER: _ClassVar[int]
    RETURN_Q_VALUES_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    SYMMETRIC_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    WORLD_FIELD_NUMBER: _ClassVar[int]
    RETURN_VELOCITY_FIELD_NUMBER: _ClassVar[int]
    RETURN_WAYPOINT_FIELD_NUMBER: _ClassVar[int]
    CONSTRAINTS_FIELD_NUMBER: _ClassVar[int]
    EXPLAIN_FIELD_NUMBER: _ClassVar[int]
    policy: str
    graph: Graph
    scene: Scene
    session_id: str
    recurrent_state: bytes
    step: int
    run_id: str
    return_q_values: bool
    seed: int
    symmetric: bool
    frame: Frame
    world: World
    return_velocity: bool
    return_waypoint: bool
    constraints: Constraints
    explain: bool
    def __init__(self, policy: _Optional[str] = ..., graph: _Optional[_Union[Graph, _Mapping]] = ..., scene: _Optional[_Union[Scene, _Mapping]] = ..., session_id: _Optional[str] = ..., recurrent_state: _Optional[bytes] = ..., step: _Optional[int] = ..., run_id: _Optional[str] = ..., return_q_values: bool = ..., seed: _Optional[int] = ..., symmetric: bool = ..., frame: _Optional[_Union[Frame, _Mapping]] = ..., world: _Optional[_Union[World, _Mapping]] = ..., return_velocity: bool = ..., return_waypoint: bool = ..., constraints: _Optional[_Union[Constraints, _Mapping]] = ..., explain: bool = ...) -> None: ...

class EncodeRequest(_message.Message):
    __slots__ = ("policy", "uav_ids", "user_ids", "observation", "state", "seed", "step", "frame", "world")
    POLICY_FIELD_NUMBER: _ClassVar[int]
    UAV_IDS_FIELD_NUMBER: _ClassVar[int]
    USER_IDS_FIELD_NUMBER: _ClassVar[int]
    OBSERVATION_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    WORLD_FIELD_NUMBER: _ClassVar[int]
    policy: str
    uav_ids: _containers.RepeatedScalarFieldContainer[str]
    user_ids: _containers.RepeatedScalarFieldContainer[str]
    observation: Node
    state: bytes
    seed: int
    step: int
    frame: Frame
    world: World
    def __init__(self, policy: _Optional[str] = ..., uav_ids: _Optional[_Iterable[str]] = ..., user_ids: _Optional[_Iterable[str]] = ..., observation: _Optional[_Union[Node, _Mapping]] = ..., state: _Optional[bytes] = ..., seed: _Optional[int] = ..., step: _Optional[int] = ..., frame: _Optional[_Union[Frame, _Mapping]] = ..., world: _Optional[_Union[World, _Mapping]] = ...) -> None: ...

class EncodeResponse(_message.Message):
    __slots__ = ("state", "message", "policy", "step", "message_links", "message_range")
    STATE_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    POLICY_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_LINKS_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_RANGE_FIELD_NUMBER: _ClassVar[int]
    state: bytes
    message: bytes
    policy: PolicyRef
    step: int
    message_links: int
    message_range: float
    def __init__(self, state: _Optional[bytes] = ..., message: _Optional[bytes] = ..., policy: _Optional[_Union[PolicyRef, _Mapping]] = ..., step: _Optional[int] = ..., message_links: _Optional[int] = ..., message_range: _Optional[float] = ...) -> None: ...

class DecideRequest(_message.Message):
    __slots__ = ("policy", "state", "messages", "return_q_values", "return_velocity", "return_waypoint", "frame", "world")
    POLICY_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    MESSAGES_FIELD_NUMBER: _ClassVar[int]
    RETURN_Q_VALUES_FIELD_NUMBER: _ClassVar[int]
    RETURN_VELOCITY_FIELD_NUMBER: _ClassVar[int]
    RETURN_WAYPOINT_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    WORLD_FIELD_NUMBER: _ClassVar[int]
    policy: str
    state: bytes
    messages: _containers.RepeatedScalarFieldContainer[bytes]
    return_q_values: bool
    return_velocity: bool
    return_waypoint: bool
    frame: Frame
    world: World
    def __init__(self, policy: _Optional[str] = ..., state: _Optional[bytes] = ..., messages: _Optional[_Iterable[bytes]] = ..., return_q_values: bool = ..., return_velocity: bool = ..., return_waypoint: bool = ..., frame: _Optional[_Union[Frame, _Mapping]] = ..., world: _Optional[_Union[World, _Mapping]] = ...) -> None: ...

class DecideResponse(_message.Message):
    __slots__ = ("action", "state", "policy", "step", "missing_uav_ids")
    ACTION_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    POLICY_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    MISSING_UAV_IDS_FIELD_NUMBER: _ClassVar[int]
    action: Action
    state: bytes
    policy: PolicyRef
    step: int
    missing_uav_ids: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, action: _Optional[_Union[Action, _Mapping]] = ..., state: _Optional[bytes] = ..., policy: _Optional[_Union[PolicyRef, _Mapping]] = ..., step: _Optional[int] = ..., missing_uav_ids: _Optional[_Iterable[str]] = ...) -> None: ...

class Constraints(_message.Message):
    __slots__ = ("no_fly", "min_separation", "home", "max_distance", "return_in_time")
    NO_FLY_FIELD_NUMBER: _ClassVar[int]
    MIN_SEPARATION_FIELD_NUMBER: _ClassVar[int]
    HOME_FIELD_NUMBER: _ClassVar[int]
    MAX_DISTANCE_FIELD_NUMBER: _ClassVar[int]
    RETURN_IN_TIME_FIELD_NUMBER: _ClassVar[int]
    no_fly: _containers.RepeatedCompositeFieldContainer[Zone]
    min_separation: float
    home: Position
    max_distance: float
    return_in_time: bool
    def __init__(self, no_fly: _Optional[_Iterable[_Union[Zone, _Mapping]]] = ..., min_separation: _Optional[float] = ..., home: _Optional[_Union[Position, _Mapping]] = ..., max_distance: _Optional[float] = ..., return_in_time: bool = ...) -> None: ...

class Zone(_message.Message):
    __slots__ = ("corners", "center", "radius")
    CORNERS_FIELD_NUMBER: _ClassVar[int]
    CENTER_FIELD_NUMBER: _ClassVar[int]
    RADIUS_FIELD_NUMBER: _ClassVar[int]
    corners: _containers.RepeatedCompositeFieldContainer[Position]
    center: Position
    radius: float
    def __init__(self, corners: _Optional[_Iterable[_Union[Position, _Mapping]]] = ..., center: _Optional[_Union[Position, _Mapping]] = ..., radius: _Optional[float] = ...) -> None: ...

class Overruled(_message.Message):
    __slots__ = ("preferred_heading_index", "because", "violates")
    PREFERRED_HEADING_INDEX_FIELD_NUMBER: _ClassVar[int]
    BECAUSE_FIELD_NUMBER: _ClassVar[int]
    VIOLATES_FIELD_NUMBER: _ClassVar[int]
    preferred_heading_index: int
    because: _containers.RepeatedScalarFieldContainer[Constraint]
    violates: _containers.RepeatedScalarFieldContainer[Constraint]
    def __init__(self, preferred_heading_index: _Optional[int] = ..., because: _Optional[_Iterable[_Union[Constraint, str]]] = ..., violates: _Optional[_Iterable[_Union[Constraint, str]]] = ...) -> None: ...

class Frame(_message.Message):
    __slots__ = ("origin", "side", "width", "height", "rotation_deg")
    ORIGIN_FIELD_NUMBER: _ClassVar[int]
    SIDE_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    ROTATION_DEG_FIELD_NUMBER: _ClassVar[int]
    origin: Position
    side: float
    width: float
    height: float
    rotation_deg: float
    def __init__(self, origin: _Optional[_Union[Position, _Mapping]] = ..., side: _Optional[float] = ..., width: _Optional[float] = ..., height: _Optional[float] = ..., rotation_deg: _Optional[float] = ...) -> None: ...

class World(_message.Message):
    __slots__ = ("slot_seconds", "speed", "transmission_range", "detection_range", "communication_range", "slots", "boundary")
    SLOT_SECONDS_FIELD_NUMBER: _ClassVar[int]
    SPEED_FIELD_NUMBER: _ClassVar[int]
    TRANSMISSION_RANGE_FIELD_NUMBER: _ClassVar[int]
    DETECTION_RANGE_FIELD_NUMBER: _ClassVar[int]
    COMMUNICATION_RANGE_FIELD_NUMBER: _ClassVar[int]
    SLOTS_FIELD_NUMBER: _ClassVar[int]
    BOUNDARY_FIELD_NUMBER: _ClassVar[int]
    slot_seconds: float
    speed: float
    transmission_range: float
    detection_range: float
    communication_range: float
    slots: int
    boundary: Boundary
    def __init__(self, slot_seconds: _Optional[float] = ..., speed: _Optional[float] = ..., transmission_range: _Optional[float] = ..., detection_range: _Optional[float] = ..., communication_range: _Optional[float] = ..., slots: _Optional[int] = ..., boundary: _Optional[_Union[Boundary, str]] = ...) -> None: ...

class Graph(_message.Message):
    __slots__ = ("nodes",)
    NODES_FIELD_NUMBER: _ClassVar[int]
    nodes: _containers.RepeatedCompositeFieldContainer[Node]
    def __init__(self, nodes: _Optional[_Iterable[_Union[Node, _Mapping]]] = ...) -> None: ...

class Node(_message.Message):
    __slots__ = ("id", "kind", "detections", "position", "aoi", "speed", "endurance_seconds")
    ID_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    DETECTIONS_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    AOI_FIELD_NUMBER: _ClassVar[int]
    SPEED_FIELD_NUMBER: _ClassVar[int]
    ENDURANCE_SECONDS_FIELD_NUMBER: _ClassVar[int]
    id: str
    kind: NodeKind
    detections: _containers.RepeatedCompositeFieldContainer[Detection]
    position: Position
    aoi: float
    speed: float
    endurance_seconds: float
    def __init__(self, id: _Optional[str] = ..., kind: _Optional[_Union[NodeKind, str]] = ..., detections: _Optional[_Iterable[_Union[Detection, _Mapping]]] = ..., position: _Optional[_Union[Position, _Mapping]] = ..., aoi: _Optional[float] = ..., speed: _Optional[float] = ..., endurance_seconds: _Optional[float] = ...) -> None: ...

class Detection(_message.Message):
    __slots__ = ("target_id", "rel_x", "rel_y", "aoi", "rel_z")
    TARGET_ID_FIELD_NUMBER: _ClassVar[int]
    REL_X_FIELD_NUMBER: _ClassVar[int]
    REL_Y_FIELD_NUMBER: _ClassVar[int]
    AOI_FIELD_NUMBER: _ClassVar[int]
    REL_Z_FIELD_NUMBER: _ClassVar[int]
    target_id: str
    rel_x: float
    rel_y: float
    aoi: float
    rel_z: float
    def __init__(self, target_id: _Optional[str] = ..., rel_x: _Optional[float] = ..., rel_y: _Optional[float] = ..., aoi: _Optional[float] = ..., rel_z: _Optional[float] = ...) -> None: ...

class Position(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Scene(_message.Message):
    __slots__ = ("uavs", "users")
    UAVS_FIELD_NUMBER: _ClassVar[int]
    USERS_FIELD_NUMBER: _ClassVar[int]
    uavs: _containers.RepeatedCompositeFieldContainer[SceneUav]
    users: _containers.RepeatedCompositeFieldContainer[SceneUser]
    def __init__(self, uavs: _Optional[_Iterable[_Union[SceneUav, _Mapping]]] = ..., users: _Optional[_Iterable[_Union[SceneUser, _Mapping]]] = ...) -> None: ...

class SceneUav(_message.Message):
    __slots__ = ("id", "x", "y", "z", "speed", "endurance_seconds")
    ID_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    SPEED_FIELD_NUMBER: _ClassVar[int]
    ENDURANCE_SECONDS_FIELD_NUMBER: _ClassVar[int]
    id: str
    x: float
    y: float
    z: float
    speed: float
    endurance_seconds: float
    def __init__(self, id: _Optional[str] = ..., x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ..., speed: _Optional[float] = ..., endurance_seconds: _Optional[float] = ...) -> None: ...

class SceneUser(_message.Message):
    __slots__ = ("id", "x", "y", "aoi", "z")
    ID_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    AOI_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    id: str
    x: float
    y: float
    aoi: float
    z: float
    def __init__(self, id: _Optional[str] = ..., x: _Optional[float] = ..., y: _Optional[float] = ..., aoi: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class ActResponse(_message.Message):
    __slots__ = ("actions", "policy", "step", "recurrent_state", "timings")
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    POLICY_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    RECURRENT_STATE_FIELD_NUMBER: _ClassVar[int]
    TIMINGS_FIELD_NUMBER: _ClassVar[int]
    actions: _containers.RepeatedCompositeFieldContainer[Action]
    policy: PolicyRef
    step: int
    recurrent_state: bytes
    timings: Timings
    def __init__(self, actions: _Optional[_Iterable[_Union[Action, _Mapping]]] = ..., policy: _Optional[_Union[PolicyRef, _Mapping]] = ..., step: _Optional[int] = ..., recurrent_state: _Optional[bytes] = ..., timings: _Optional[_Union[Timings, _Mapping]] = ...) -> None: ...

class Action(_message.Message):
    __slots__ = ("uav_id", "heading_index", "heading_deg", "q_values", "velocity", "waypoint", "overruled", "influences")
    UAV_ID_FIELD_NUMBER: _ClassVar[int]
    HEADING_INDEX_FIELD_NUMBER: _ClassVar[int]
    HEADING_DEG_FIELD_NUMBER: _ClassVar[int]
    Q_VALUES_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    WAYPOINT_FIELD_NUMBER: _ClassVar[int]
    OVERRULED_FIELD_NUMBER: _ClassVar[int]
    INFLUENCES_FIELD_NUMBER: _ClassVar[int]
    uav_id: str
    heading_index: int
    heading_deg: float
    q_values: _containers.RepeatedScalarFieldContainer[float]
    velocity: Velocity
    waypoint: Position
    overruled: Overruled
    influences: _containers.RepeatedCompositeFieldContainer[Influence]
    def __init__(self, uav_id: _Optional[str] = ..., heading_index: _Optional[int] = ..., heading_deg: _Optional[float] = ..., q_values: _Optional[_Iterable[float]] = ..., velocity: _Optional[_Union[Velocity, _Mapping]] = ..., waypoint: _Optional[_Union[Position, _Mapping]] = ..., overruled: _Optional[_Union[Overruled, _Mapping]] = ..., influences: _Optional[_Iterable[_Union[Influence, _Mapping]]] = ...) -> None: ...

class Influence(_message.Message):
    __slots__ = ("node_id", "message", "change")
    NODE_ID_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    CHANGE_FIELD_NUMBER: _ClassVar[int]
    node_id: str
    message: bool
    change: float
    def __init__(self, node_id: _Optional[str] = ..., message: bool = ..., change: _Optional[float] = ...) -> None: ...

class Velocity(_message.Message):
    __slots__ = ("x", "y")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ...) -> None: ...

class PolicyRef(_message.Message):
    __slots__ = ("name", "version", "digest")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    DIGEST_FIELD_NUMBER: _ClassVar[int]
    name: str
    version: int
    digest: str
    def __init__(self, name: _Optional[str] = ..., version: _Optional[int] = ..., digest: _Optional[str] = ...) -> None: ...

class Timings(_message.Message):
    __slots__ = ("queue", "compute", "batch_size")
    QUEUE_FIELD_NUMBER: _ClassVar[int]
    COMPUTE_FIELD_NUMBER: _ClassVar[int]
    BATCH_SIZE_FIELD_NUMBER: _ClassVar[int]
    queue: _duration_pb2.Duration
    compute: _duration_pb2.Duration
    batch_size: int
    def __init__(self, queue: _Optional[_Union[datetime.timedelta, _duration_pb2.Duration, _Mapping]] = ..., compute: _Optional[_Union[datetime.timedelta, _duration_pb2.Duration, _Mapping]] = ..., batch_size: _Optional[int] = ...) -> None: ...

class ActBatchRequest(_message.Message):
    __slots__ = ("requests",)
    REQUESTS_FIELD_NUMBER: _ClassVar[int]
    requests: _containers.RepeatedCompositeFieldContainer[ActRequest]
    def __init__(self, requests: _Optional[_Iterable[_Union[ActRequest, _Mapping]]] = ...) -> None: ...

class ActBatchResponse(_message.Message):
    __slots__ = ("results",)
    RESULTS_FIELD_NUMBER: _ClassVar[int]
    results: _containers.RepeatedCompositeFieldContainer[ActResult]
    def __init__(self, results: _Optional[_Iterable[_Union[ActResult, _Mapping]]] = ...) -> None: ...

class ActResult(_message.Message):
    __slots__ = ("response", "error")
    RESPONSE_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    response: ActResponse
    error: ActError
    def __init__(self, response: _Optional[_Union[ActResponse, _Mapping]] = ..., error: _Optional[_Union[ActError, _Mapping]] = ...) -> None: ...

class ActError(_message.Message):
    __slots__ = ("status", "code", "message", "field")
    STATUS_FIELD_NUMBER: _ClassVar[int]
    CODE_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    FIELD_FIELD_NUMBER: _ClassVar[int]
    status: int
    code: str
    message: str
    field: str
    def __init__(self, status: _Optional[int] = ..., code: _Optional[str] = ..., message: _Optional[str] = ..., field: _Optional[str] = ...) -> None: ...

class OpenSessionRequest(_message.Message):
    __slots__ = ("policy", "session_id", "run_id", "seed", "symmetric", "frame", "world", "constraints")
    POLICY_FIELD_NUMBER: _ClassVar[int]
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    RUN_ID_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    SYMMETRIC_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    WORLD_FIELD_NUMBER: _ClassVar[int]
    CONSTRAINTS_FIELD_NUMBER: _ClassVar[int]
    policy: str
    session_id: str
    run_id: str
    seed: int
    symmetric: bool
    frame: Frame
    world: World
    constraints: Constraints
    def __init__(self, policy: _Optional[str] = ..., session_id: _Optional[str] = ..., run_id: _Optional[str] = ..., seed: _Optional[int] = ..., symmetric: bool = ..., frame: _Optional[_Union[Frame, _Mapping]] = ..., world: _Optional[_Union[World, _Mapping]] = ..., constraints: _Optional[_Union[Constraints, _Mapping]] = ...) -> None: ...

class GetSessionRequest(_message.Message):
    __slots__ = ("session_id",)
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    def __init__(self, session_id: _Optional[str] = ...) -> None: ...

class ListSessionsRequest(_message.Message):
    __slots__ = ("page_size", "page_token")
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    page_size: int
    page_token: str
    def __init__(self, page_size: _Optional[int] = ..., page_token: _Optional[str] = ...) -> None: ...

class ListSessionsResponse(_message.Message):
    __slots__ = ("sessions", "next_page_token")
    SESSIONS_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    sessions: _containers.RepeatedCompositeFieldContainer[Session]
    next_page_token: str
    def __init__(self, sessions: _Optional[_Iterable[_Union[Session, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class CloseSessionRequest(_message.Message):
    __slots__ = ("session_id",)
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    def __init__(self, session_id: _Optional[str] = ...) -> None: ...

class Session(_message.Message):
    __slots__ = ("session_id", "policy", "steps", "opened_at", "ttl", "owner", "warnings")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    POLICY_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    OPENED_AT_FIELD_NUMBER: _ClassVar[int]
    TTL_FIELD_NUMBER: _ClassVar[int]
    OWNER_FIELD_NUMBER: _ClassVar[int]
    WARNINGS_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    policy: PolicyRef
    steps: int
    opened_at: _timestamp_pb2.Timestamp
    ttl: _duration_pb2.Duration
    owner: str
    warnings: _containers.RepeatedCompositeFieldContainer[Warning]
    def __init__(self, session_id: _Optional[str] = ..., policy: _Optional[_Union[PolicyRef, _Mapping]] = ..., steps: _Optional[int] = ..., opened_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., ttl: _Optional[_Union[datetime.timedelta, _duration_pb2.Duration, _Mapping]] = ..., owner: _Optional[str] = ..., warnings: _Optional[_Iterable[_Union[Warning, _Mapping]]] = ...) -> None: ...

class Warning(_message.Message):
    __slots__ = ("field", "message")
    FIELD_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    field: str
    message: str
    def __init__(self, field: _Optional[str] = ..., message: _Optional[str] = ...) -> None: ...

class ListPoliciesRequest(_message.Message):
    __slots__ = ("page_size", "page_token")
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    page_size: int
    page_token: str
    def __init__(self, page_size: _Optional[int] = ..., page_token: _Optional[str] = ...) -> None: ...

class ListPoliciesResponse(_message.Message):
    __slots__ = ("policies", "next_page_token")
    POLICIES_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    policies: _containers.RepeatedCompositeFieldContainer[Policy]
    next_page_token: str
    def __init__(self, policies: _Optional[_Iterable[_Union[Policy, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class GetPolicyRequest(_message.Message):
    __slots__ = ("policy",)
    POLICY_FIELD_NUMBER: _ClassVar[int]
    policy: str
    def __init__(self, policy: _Optional[str] = ...) -> None: ...

class ListPolicyVersionsRequest(_message.Message):
    __slots__ = ("name", "page_size", "page_token")
    NAME_FIELD_NUMBER: _ClassVar[int]
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    name: str
    page_size: int
    page_token: str
    def __init__(self, name: _Optional[str] = ..., page_size: _Optional[int] = ..., page_token: _Optional[str] = ...) -> None: ...

class PolicyVersion(_message.Message):
    __slots__ = ("ref", "loaded", "aliases")
    REF_FIELD_NUMBER: _ClassVar[int]
    LOADED_FIELD_NUMBER: _ClassVar[int]
    ALIASES_FIELD_NUMBER: _ClassVar[int]
    ref: PolicyRef
    loaded: bool
    aliases: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, ref: _Optional[_Union[PolicyRef, _Mapping]] = ..., loaded: bool = ..., aliases: _Optional[_Iterable[str]] = ...) -> None: ...

class ListPolicyVersionsResponse(_message.Message):
    __slots__ = ("versions", "next_page_token")
    VERSIONS_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    versions: _containers.RepeatedCompositeFieldContainer[PolicyVersion]
    next_page_token: str
    def __init__(self, versions: _Optional[_Iterable[_Union[PolicyVersion, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class DeletePolicyVersionRequest(_message.Message):
    __slots__ = ("name", "version")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    name: str
    version: int
    def __init__(self, name: _Optional[str] = ..., version: _Optional[int] = ...) -> None: ...

class DeletePolicyVersionResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class DeletePolicyRequest(_message.Message):
    __slots__ = ("name",)
    NAME_FIELD_NUMBER: _ClassVar[int]
    name: str
    def __init__(self, name: _Optional[str] = ...) -> None: ...

class DeletePolicyResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class Policy(_message.Message):
    __slots__ = ("ref", "kind", "description", "uavs", "users", "headings", "needs", "detection_range", "aliases", "versions", "config", "metrics", "created_at", "loaded", "loaded_versions", "version_count", "world")
    REF_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    DESCRIPTION_FIELD_NUMBER: _ClassVar[int]
    UAVS_FIELD_NUMBER: _ClassVar[int]
    USERS_FIELD_NUMBER: _ClassVar[int]
    HEADINGS_FIELD_NUMBER: _ClassVar[int]
    NEEDS_FIELD_NUMBER: _ClassVar[int]
    DETECTION_RANGE_FIELD_NUMBER: _ClassVar[int]
    ALIASES_FIELD_NUMBER: _ClassVar[int]
    VERSIONS_FIELD_NUMBER: _ClassVar[int]
    CONFIG_FIELD_NUMBER: _ClassVar[int]
    METRICS_FIELD_NUMBER: _ClassVar[int]
    CREATED_AT_FIELD_NUMBER: _ClassVar[int]
    LOADED_FIELD_NUMBER: _ClassVar[int]
    LOADED_VERSIONS_FIELD_NUMBER: _ClassVar[int]
    VERSION_COUNT_FIELD_NUMBER: _ClassVar[int]
    WORLD_FIELD_NUMBER: _ClassVar[int]
    ref: PolicyRef
    kind: PolicyKind
    description: str
    uavs: int
    users: int
    headings: int
    needs: Needs
    detection_range: float
    aliases: _containers.RepeatedScalarFieldContainer[str]
    versions: _containers.RepeatedScalarFieldContainer[int]
    config: _struct_pb2.Struct
    metrics: _struct_pb2.Struct
    created_at: _timestamp_pb2.Timestamp
    loaded: bool
    loaded_versions: _containers.RepeatedScalarFieldContainer[int]
    version_count: int
    world: World
    def __init__(self, ref: _Optional[_Union[PolicyRef, _Mapping]] = ..., kind: _Optional[_Union[PolicyKind, str]] = ..., description: _Optional[str] = ..., uavs: _Optional[int] = ..., users: _Optional[int] = ..., headings: _Optional[int] = ..., needs: _Optional[_Union[Needs, str]] = ..., detection_range: _Optional[float] = ..., aliases: _Optional[_Iterable[str]] = ..., versions: _Optional[_Iterable[int]] = ..., config: _Optional[_Union[_struct_pb2.Struct, _Mapping]] = ..., metrics: _Optional[_Union[_struct_pb2.Struct, _Mapping]] = ..., created_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., loaded: bool = ..., loaded_versions: _Optional[_Iterable[int]] = ..., version_count: _Optional[int] = ..., world: _Optional[_Union[World, _Mapping]] = ...) -> None: ...
