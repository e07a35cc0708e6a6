"""A request that the daemon refuses: an error with the protocol's code."""

from bricktrack_common.errors import DeviceError
from bricktrack_common.wire_messages import ErrorCode


class RequestRefusedError(DeviceError):
    """The daemon does not do what was asked; ``code`` and message go to the host as they are."""

    def __init__(self, code: ErrorCode, message: str) -> None:
        super().__init__(message)
        self.code: ErrorCode = code
