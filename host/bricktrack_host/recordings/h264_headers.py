"""The few header fields of H.264 that tell whether a picture is missing or stored out of order.

A decoder that meets a gap in ``frame_num`` invents the missing reference without a word. `PictureOrder`
reads the numbers itself, so that everything predicted from an invented picture can be told from the rest.
"""

from dataclasses import dataclass
from typing import Literal

from bricktrack_common.errors import VideoError
from bricktrack_host.recordings.annex_b import NAL_IDR, NAL_SLICE, NAL_SPS, Buffer, NalUnit, iter_nal_units

_HIGH_PROFILES = (100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135)
_SPS_BYTES = 400
_SLICE_HEADER_BYTES = 24
_B_SLICE, _I_SLICE = 1, 2

Order = Literal["follows", "gap", "unreadable"]


@dataclass(frozen=True, slots=True)
class SequenceParameters:
    """What of a sequence parameter set is needed to read a slice header."""

    log2_max_frame_num: int
    max_references: int
    gaps_allowed: bool
    separate_colour_planes: bool
    frames_only: bool


@dataclass(frozen=True, slots=True)
class SliceHeader:
    """The beginning of a slice header; ``slice_type`` is 0 P, 1 B, 2 I, 3 SP, 4 SI."""

    first_mb: int
    slice_type: int
    frame_num: int


class _Bits:
    """Reads bits and Exp-Golomb numbers, ITU-T H.264 9.1, from a NAL unit's payload."""

    def __init__(self, nal: bytes) -> None:
        # Emulation prevention: 00 00 03 stands for 00 00 (7.4.1).
        payload = nal.replace(b"\x00\x00\x03", b"\x00\x00")
        self._value = int.from_bytes(payload, "big")
        self._left = 8 * len(payload)

    def u(self, n: int) -> int:
        if n > self._left:
            raise VideoError("an H.264 header ends before its fields do")
        self._left -= n
        return (self._value >> self._left) & ((1 << n) - 1)

    def ue(self) -> int:
        zeros = 0
        while self.u(1) == 0:
            zeros += 1
            if zeros > 32:
                raise VideoError("an H.264 header holds no valid Exp-Golomb number")
        return (1 << zeros) - 1 + self.u(zeros)

    def se(self) -> int:
        k = self.ue()
        return (k + 1) // 2 if k % 2 else -(k // 2)


def parse_sequence_parameters(nal: bytes) -> SequenceParameters:
    """Return the fields of a sequence parameter set (7.3.2.1.1) up to ``frame_mbs_only_flag``.

    Parameters
    ----------
    nal : bytes
        From the header byte on.
    """
    bits = _Bits(nal[1:])
    profile = bits.u(8)
    bits.u(16)
    bits.ue()
    separate = False
    if profile in _HIGH_PROFILES:
        chroma_format = bits.ue()
        if chroma_format == 3:
            separate = bits.u(1) == 1
        bits.ue()
        bits.ue()
        bits.u(1)
        if bits.u(1):
            for i in range(8 if chroma_format != 3 else 12):
                if bits.u(1):
                    _skip_scaling_list(bits, 16 if i < 6 else 64)
    log2_max_frame_num = bits.ue() + 4
    order_type = bits.ue()
    if order_type == 0:
        bits.ue()
    elif order_type == 1:
        bits.u(1)
        bits.se()
        bits.se()
        for _ in range(bits.ue()):
            bits.se()
    max_references = bits.ue()
    gaps_allowed = bits.u(1) == 1
    bits.ue()
    bits.ue()
    frames_only = bits.u(1) == 1
    return SequenceParameters(log2_max_frame_num, max_references, gaps_allowed, separate, frames_only)


def _skip_scaling_list(bits: _Bits, size: int) -> None:
    last, following = 8, 8
    for _ in range(size):
        if following:
            following = (last + bits.se()) % 256
        last = following or last


def parse_slice_header(nal: bytes, sequence: SequenceParameters) -> SliceHeader:
    """Return the first fields of a slice header (7.3.3); ``nal`` is from the header byte on."""
    bits = _Bits(nal[1:])
    first_mb = bits.ue()
    slice_type = bits.ue() % 5
    bits.ue()
    if sequence.separate_colour_planes:
        bits.u(2)
    return SliceHeader(first_mb, slice_type, bits.u(sequence.log2_max_frame_num))


class PictureOrder:
    """Follows the frame numbers of successive access units.

    Attributes
    ----------
    sequence : SequenceParameters or None
        The parameter set in force.
    n_b_pictures : int
        Pictures that begin with a B slice: such streams are stored in another order than they are shown in.
    """

    def __init__(self) -> None:
        self.sequence: SequenceParameters | None = None
        self.n_b_pictures = 0
        self._last_reference: int | None = None

    def check(self, unit: Buffer) -> tuple[Order, bool]:
        """Return how an access unit follows the one before, and whether prediction begins anew with it.

        ``"gap"`` means that a picture which this one may be predicted from is not in the stream (7.4.3,
        ``frame_num``). ``"unreadable"`` means that the unit has no slice or no parameter set.

        Prediction begins anew with an IDR picture, and with an intra picture where the sequence keeps but
        one reference: it takes the place of all earlier ones.
        """
        first: tuple[NalUnit, SliceHeader | None] | None = None
        all_intra = True
        for nal in iter_nal_units(unit):
            if nal.nal_type == NAL_SPS:
                try:
                    self.sequence = parse_sequence_parameters(
                        bytes(unit[nal.header : nal.header + _SPS_BYTES])
                    )
                except VideoError:
                    return "unreadable", False
            elif nal.nal_type in (NAL_SLICE, NAL_IDR):
                header = self._slice_header(unit, nal)
                if first is None:
                    first = nal, header
                    if nal.nal_type == NAL_IDR or header is None or header.slice_type != _I_SLICE:
                        break
                elif header is None or header.slice_type != _I_SLICE:
                    all_intra = False
                    break
        if first is None:
            return "unreadable", False
        nal, header = first
        if header is None:
            return "unreadable", nal.nal_type == NAL_IDR
        return self._check_picture(nal, header, all_intra=all_intra)

    def _slice_header(self, unit: Buffer, nal: NalUnit) -> SliceHeader | None:
        if self.sequence is None:
            return None
        try:
            return parse_slice_header(
                bytes(unit[nal.header : nal.header + _SLICE_HEADER_BYTES]), self.sequence
            )
        except VideoError:
            return None

    def _check_picture(self, nal: NalUnit, header: SliceHeader, *, all_intra: bool) -> tuple[Order, bool]:
        sequence = self.sequence
        if sequence is None:
            return "unreadable", False
        self.n_b_pictures += header.slice_type == _B_SLICE
        is_idr, last = nal.nal_type == NAL_IDR, self._last_reference
        alone = (
            header.slice_type == _I_SLICE
            and all_intra
            and nal.ref_idc != 0
            and sequence.max_references <= 1
            and last is not None  # a decoder does not start at such a picture
        )
        order: Order = "follows"
        if not (is_idr or alone or sequence.gaps_allowed) and (
            last is None or header.frame_num != (last + 1) % (1 << sequence.log2_max_frame_num)
        ):
            order = "gap"
        if nal.ref_idc != 0:
            self._last_reference = header.frame_num
        return order, is_idr or alone
