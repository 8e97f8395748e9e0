"""Machine-readable error codes of answers, and one-line error messages for people."""

from __future__ import annotations

from enum import StrEnum

from graspd_core import errors
from graspd_core.errors import GraspdError


class ErrorCode(StrEnum):
    """Values of `error_code` in a GraspArray and of `code` in events on `~/status`. The empty code means no error."""

    NONE = ""
    BAD_REQUEST = "BAD_REQUEST"  # a field is out of range or unknown
    BAD_MESH = "BAD_MESH"  # the mesh cannot be read, used or reached
    BAD_CLOUD = "BAD_CLOUD"  # the cloud or depth image cannot be read or shows no usable object
    BAD_LIBRARY = "BAD_LIBRARY"  # grasp_library is damaged, of another version, locked or missing
    NO_OBJECT = "NO_OBJECT"  # the scene does not contain the requested object
    NO_CLOUD = "NO_CLOUD"  # LATEST_CLOUD before a cloud has arrived, or VIEWS before a view is stored
    STALE_CLOUD = "STALE_CLOUD"  # the cloud is older than cloud_max_age
    NO_TRANSFORM = "NO_TRANSFORM"  # /tf does not connect the frames
    WRONG_HAND = "WRONG_HAND"  # the request needs a hand that this node does not plan for
    NOT_FOUND = "NOT_FOUND"  # a message on ~/cancel names a request that is neither waiting nor running
    DUPLICATE_ID = "DUPLICATE_ID"  # a request with this id is waiting or running
    BUSY = "BUSY"  # busy_policy refuses requests while the node is busy, or the queue is full
    SHUTTING_DOWN = "SHUTTING_DOWN"  # the node is shutting down
    CANCELLED = "CANCELLED"  # cancelled by ~/cancel, ~/reset, the action's client or the node's shutdown
    SUPERSEDED = "SUPERSEDED"  # a newer request took its place
    DEADLINE = "DEADLINE"  # time_budget passed before enough grasps were found
    NO_GRASP = "NO_GRASP"  # fewer grasps than requested passed the trials
    OUT_OF_MEMORY = "OUT_OF_MEMORY"
    INTERNAL = "INTERNAL"  # a bug in graspd. The node's log has the traceback


class RequestError(GraspdError):
    """The request cannot be processed. `code` is the error code."""

    def __init__(self, code: ErrorCode, message: str) -> None:
        super().__init__(message)
        self.code = code


def bad_request(message: str) -> RequestError:
    """Return the error for an invalid field or message."""
    return RequestError(ErrorCode.BAD_REQUEST, message)


# The first matching row counts, so subclasses stand before their bases.
_CODES: tuple[tuple[type[BaseException], ErrorCode], ...] = (
    (errors.NoObjectError, ErrorCode.NO_OBJECT),
    (errors.CloudError, ErrorCode.BAD_CLOUD),
    (errors.MeshError, ErrorCode.BAD_MESH),
    (errors.TransformError, ErrorCode.NO_TRANSFORM),
    (errors.HandError, ErrorCode.WRONG_HAND),
    (errors.ConfigError, ErrorCode.BAD_REQUEST),
    (errors.FormatError, ErrorCode.BAD_LIBRARY),
    (errors.ResourceError, ErrorCode.OUT_OF_MEMORY),
    (MemoryError, ErrorCode.OUT_OF_MEMORY),
)


def code_of(error: BaseException) -> ErrorCode:
    """Return the code of the error that ended a request."""
    if isinstance(error, RequestError):
        return error.code
    if isinstance(error, RuntimeError) and "allocate memory" in str(error):  # torch's error for too little memory
        return ErrorCode.OUT_OF_MEMORY
    return next((code for kind, code in _CODES if isinstance(error, kind)), ErrorCode.INTERNAL)


def sentence_of(error: BaseException) -> str:
    """Return an error as one line for people. Unexpected exceptions are marked as internal errors."""
    if isinstance(error, GraspdError | OSError):
        text = str(error)
    else:
        text = f"internal error: {type(error).__name__}: {error}"
    return " ".join(text.split())
