from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class EnvironmentRequest(_message.Message):
    __slots__ = ("hello", "batch")
    HELLO_FIELD_NUMBER: _ClassVar[int]
    BATCH_FIELD_NUMBER: _ClassVar[int]
    hello: EnvironmentHello
    batch: EnvironmentBatch
    def __init__(self, hello: _Optional[_Union[EnvironmentHello, _Mapping]] = ..., batch: _Optional[_Union[EnvironmentBatch, _Mapping]] = ...) -> None: ...

class EnvironmentReply(_message.Message):
    __slots__ = ("welcome", "results")
    WELCOME_FIELD_NUMBER: _ClassVar[int]
    RESULTS_FIELD_NUMBER: _ClassVar[int]
    welcome: EnvironmentWelcome
    results: EnvironmentResults
    def __init__(self, welcome: _Optional[_Union[EnvironmentWelcome, _Mapping]] = ..., results: _Optional[_Union[EnvironmentResults, _Mapping]] = ...) -> None: ...

class EnvironmentHello(_message.Message):
    __slots__ = ("protocol_version", "segmentation", "environments")
    PROTOCOL_VERSION_FIELD_NUMBER: _ClassVar[int]
    SEGMENTATION_FIELD_NUMBER: _ClassVar[int]
    ENVIRONMENTS_FIELD_NUMBER: _ClassVar[int]
    protocol_version: int
    segmentation: bool
    environments: int
    def __init__(self, protocol_version: _Optional[int] = ..., segmentation: bool = ..., environments: _Optional[int] = ...) -> None: ...

class EnvironmentWelcome(_message.Message):
    __slots__ = ("protocol_version", "spec", "environments")
    PROTOCOL_VERSION_FIELD_NUMBER: _ClassVar[int]
    SPEC_FIELD_NUMBER: _ClassVar[int]
    ENVIRONMENTS_FIELD_NUMBER: _ClassVar[int]
    protocol_version: int
    spec: EnvironmentSpec
    environments: int
    def __init__(self, protocol_version: _Optional[int] = ..., spec: _Optional[_Union[EnvironmentSpec, _Mapping]] = ..., environments: _Optional[int] = ...) -> None: ...

class EnvironmentSpec(_message.Message):
    __slots__ = ("id", "height", "width", "channels", "action_dim", "action_repeat", "time_limit")
    ID_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    CHANNELS_FIELD_NUMBER: _ClassVar[int]
    ACTION_DIM_FIELD_NUMBER: _ClassVar[int]
    ACTION_REPEAT_FIELD_NUMBER: _ClassVar[int]
    TIME_LIMIT_FIELD_NUMBER: _ClassVar[int]
    id: str
    height: int
    width: int
    channels: int
    action_dim: int
    action_repeat: int
    time_limit: int
    def __init__(self, id: _Optional[str] = ..., height: _Optional[int] = ..., width: _Optional[int] = ..., channels: _Optional[int] = ..., action_dim: _Optional[int] = ..., action_repeat: _Optional[int] = ..., time_limit: _Optional[int] = ...) -> None: ...

class EnvironmentBatch(_message.Message):
    __slots__ = ("number", "commands")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    COMMANDS_FIELD_NUMBER: _ClassVar[int]
    number: int
    commands: _containers.RepeatedCompositeFieldContainer[EnvironmentCommand]
    def __init__(self, number: _Optional[int] = ..., commands: _Optional[_Iterable[_Union[EnvironmentCommand, _Mapping]]] = ...) -> None: ...

class EnvironmentCommand(_message.Message):
    __slots__ = ("environment", "reset", "step")
    ENVIRONMENT_FIELD_NUMBER: _ClassVar[int]
    RESET_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    environment: int
    reset: EnvironmentReset
    step: EnvironmentStep
    def __init__(self, environment: _Optional[int] = ..., reset: _Optional[_Union[EnvironmentReset, _Mapping]] = ..., step: _Optional[_Union[EnvironmentStep, _Mapping]] = ...) -> None: ...

class EnvironmentReset(_message.Message):
    __slots__ = ("seed",)
    SEED_FIELD_NUMBER: _ClassVar[int]
    seed: int
    def __init__(self, seed: _Optional[int] = ...) -> None: ...

class EnvironmentStep(_message.Message):
    __slots__ = ("action",)
    ACTION_FIELD_NUMBER: _ClassVar[int]
    action: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, action: _Optional[_Iterable[float]] = ...) -> None: ...

class EnvironmentResults(_message.Message):
    __slots__ = ("number", "results")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    RESULTS_FIELD_NUMBER: _ClassVar[int]
    number: int
    results: _containers.RepeatedCompositeFieldContainer[EnvironmentResult]
    def __init__(self, number: _Optional[int] = ..., results: _Optional[_Iterable[_Union[EnvironmentResult, _Mapping]]] = ...) -> None: ...

class EnvironmentResult(_message.Message):
    __slots__ = ("environment", "row", "error")
    ENVIRONMENT_FIELD_NUMBER: _ClassVar[int]
    ROW_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    environment: int
    row: EnvironmentRow
    error: str
    def __init__(self, environment: _Optional[int] = ..., row: _Optional[_Union[EnvironmentRow, _Mapping]] = ..., error: _Optional[str] = ...) -> None: ...

class EnvironmentRow(_message.Message):
    __slots__ = ("image", "reward", "discount", "is_last", "is_terminal", "interaction", "end_reason", "segmentation", "metrics")
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    REWARD_FIELD_NUMBER: _ClassVar[int]
    DISCOUNT_FIELD_NUMBER: _ClassVar[int]
    IS_LAST_FIELD_NUMBER: _ClassVar[int]
    IS_TERMINAL_FIELD_NUMBER: _ClassVar[int]
    INTERACTION_FIELD_NUMBER: _ClassVar[int]
    END_REASON_FIELD_NUMBER: _ClassVar[int]
    SEGMENTATION_FIELD_NUMBER: _ClassVar[int]
    METRICS_FIELD_NUMBER: _ClassVar[int]
    image: bytes
    reward: float
    discount: float
    is_last: bool
    is_terminal: bool
    interaction: bool
    end_reason: str
    segmentation: bytes
    metrics: _containers.RepeatedCompositeFieldContainer[EnvironmentMetric]
    def __init__(self, image: _Optional[bytes] = ..., reward: _Optional[float] = ..., discount: _Optional[float] = ..., is_last: bool = ..., is_terminal: bool = ..., interaction: bool = ..., end_reason: _Optional[str] = ..., segmentation: _Optional[bytes] = ..., metrics: _Optional[_Iterable[_Union[EnvironmentMetric, _Mapping]]] = ...) -> None: ...

class EnvironmentMetric(_message.Message):
    __slots__ = ("name", "value")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    name: str
    value: float
    def __init__(self, name: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
