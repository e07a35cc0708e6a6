"""Every error raised on purpose; each is also the builtin error it specialises.

::

    BricktrackError
    ├── ShapeError (ValueError)         an array of the wrong shape or a non-finite value
    ├── ConfigError (ValueError)        a configuration, layout or calibration file says what it must not
    ├── RunFormatError (ValueError)     a run folder or stream that cannot be read as what it claims to be
    ├── ProtocolError (ValueError)      a wire message that is not of the protocol
    ├── UnitError (RuntimeError)        a unit answered a request with a refusal
    ├── UnitTimeoutError (TimeoutError) a unit did not answer
    ├── TransferError (OSError)         a pulled file does not match its manifest
    ├── DeviceError (RuntimeError)      the daemon cannot do what it was asked
    ├── HardwareError (OSError)         a sensor, a pin or a bus does not behave
    ├── StorageError (OSError)          the card is full or a folder cannot be written
    ├── CalibrationError (ValueError)   a calibration cannot be made from, or used with, these data
    ├── VideoError (ValueError)         a video that cannot be decoded or paired with its time stamps
    └── TrackingError (ValueError)      no pose can be had from what was given

A command line prints a `BricktrackError` as one line and exits with 1. Anything else is a bug and keeps
its traceback.
"""


class BricktrackError(Exception):
    """Base of every error that bricktrack raises on purpose."""


class ShapeError(BricktrackError, ValueError):
    """An array has the wrong shape or holds values that it must not."""


class ConfigError(BricktrackError, ValueError):
    """A configuration, layout or calibration file says what it must not."""


class RunFormatError(BricktrackError, ValueError):
    """A run folder or one of its streams cannot be read as what it claims to be."""


class ProtocolError(BricktrackError, ValueError):
    """A wire message is not of the protocol, or of a version that we do not speak."""


class UnitError(BricktrackError, RuntimeError):
    """A unit refused a request.

    Attributes
    ----------
    code : str
        The refusal's code, from `bricktrack_common.wire_messages.ErrorCode`.
    """

    def __init__(self, message: str, *, code: str) -> None:
        super().__init__(message)
        self.code = code


class UnitTimeoutError(BricktrackError, TimeoutError):
    """A unit did not answer in time."""


class TransferError(BricktrackError, OSError):
    """A transferred file does not match what the unit said of it."""


class DeviceError(BricktrackError, RuntimeError):
    """The daemon cannot do what it was asked in the state it is in."""


class HardwareError(BricktrackError, OSError):
    """A sensor, a pin or a bus does not behave as it must."""


class StorageError(BricktrackError, OSError):
    """The card is full, or a folder cannot be read or written."""


class CalibrationError(BricktrackError, ValueError):
    """A calibration cannot be made from, or used with, the data at hand."""


class VideoError(BricktrackError, ValueError):
    """A video cannot be decoded, or its pictures not paired with their time stamps."""


class TrackingError(BricktrackError, ValueError):
    """No pose can be had from what was given."""
