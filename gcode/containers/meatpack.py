"""MeatPack: the fifteen commonest characters of G-code in four bits each.

Sources: Marlin, src/feature/meatpack.{h,cpp} (2.1, 2022): signal bytes, commands, order of the
characters of a pair, and that the second half of a pair is void after a line end. libbgcode,
doc/specifications.md (26beabf): encodings 1 and 2 of binary G-code. What follows from its
converter, observed on its output (0.2): in lines that begin with G the spaces before words are
left out and come back when the text is unpacked, and empty lines are padding.

Encodings 1 and 2 are unpacked alike. They differ in what a slicer leaves out: the first has no
comments. What is packed here keeps its comments in both, because a comment tells that a file was
processed.
"""

from __future__ import annotations

import numpy as np

from stillpath.gcode.errors import GcodeError
from stillpath.models.jit import kernel

__all__ = ["Unpacker", "pack"]

_PACKED = b"0123456789.E\nGX"
"""Characters by nibble, without spaces (command 247): E stands where the space was."""
_WORDS = b"ACEFGHIJPRSWXYZ"
"""Letters that get a space before them when a line that begins with G is unpacked."""
_FULL = 15
_SIGNAL = 255
_ENABLE, _DISABLE, _RESET, _NO_SPACES, _SPACES = 251, 250, 249, 247, 246
_LINE_END, _SPACE, _G, _E, _SEMICOLON = 10, 32, 71, 69, 59
_PREVIOUS, _IN_G_LINE = 0, 1

_CHARACTER = np.frombuffer(_PACKED + b"\0", np.uint8)
_NIBBLE = np.full(256, _FULL, np.uint8)
_NIBBLE[_CHARACTER[:_FULL]] = np.arange(_FULL)
_IS_WORD = np.zeros(256, np.bool_)
_IS_WORD[np.frombuffer(_WORDS, np.uint8)] = True


class Unpacker:
    """Unpacks the blocks of a file one after the other.

    The packing starts afresh with each block; a line may go on in the next.
    """

    def __init__(self) -> None:
        self._line = np.array([_LINE_END, 0], np.int64)

    def push(self, data: bytes) -> bytes:
        """Return the text of a block.

        Raises
        ------
        ValueError
            The block ends in the middle of a character.
        """
        packed = np.frombuffer(data, np.uint8)
        characters = np.empty(2 * len(packed), np.uint8)
        count = _unpack(packed, characters, _CHARACTER)
        if count < 0:
            raise ValueError("ends in the middle of a MeatPack character")
        text = np.empty(2 * count, np.uint8)
        return text[: _lay_out(characters[:count], text, self._line, _IS_WORD)].tobytes()


def pack(text: bytes) -> bytes:
    """Pack lines, which come back as they are but for the following.

    Empty lines are lost, and a line that begins with G gets a space before each word that had
    none. Comments, spaces elsewhere, CR and UTF-8 are kept.

    Raises
    ------
    GcodeError
        The text holds the byte 255, which is the signal of the packing.
    """
    place = text.find(b"\xff")
    if place >= 0:
        raise GcodeError(
            "the byte 255 cannot be written with MeatPack (it is not valid UTF-8); "
            "write plain G-code, or remove it",
            text=text[:place].rpartition(b"\n")[2].decode("latin-1"),
        )
    out = np.empty(8 * len(text) + 16, np.uint8)
    count = _pack(np.frombuffer(text, np.uint8), out, _NIBBLE, _IS_WORD)
    return out[:count].tobytes()


@kernel
def _unpack(packed: np.ndarray, out: np.ndarray, character: np.ndarray) -> int:
    """Unpack a block; return the number of characters, -1 if it ends inside one."""
    n = 0
    packing = no_spaces = signal = command = False
    full = 0  # characters of full width to come
    held = -1  # the second character of a pair whose first is of full width
    for k in range(len(packed)):
        byte = int(packed[k])
        if byte == _SIGNAL:
            command, signal = signal, not signal
            continue
        if command:
            command = False
            if byte in (_ENABLE, _DISABLE):
                packing = byte == _ENABLE
            elif byte in (_NO_SPACES, _SPACES):
                no_spaces = byte == _NO_SPACES
            elif byte == _RESET:
                packing = no_spaces = False
            continue
        # A single one is no signal, but a pair of full width.
        if signal and packing and full == 0:
            signal, full = False, 2
        if full > 0 or signal or not packing:
            out[n] = _SIGNAL if signal else byte
            n += 1
            if held >= 0:
                out[n] = held
                n += 1
                held = -1
            if signal:
                out[n] = byte
                n += 1
            full, signal = max(full - (2 if signal else 1), 0), False
            continue
        low, high = byte & 15, byte >> 4
        first = int(character[low])
        second = int(character[high])
        if not no_spaces:
            first = _SPACE if first == _E else first
            second = _SPACE if second == _E else second
        if low == _FULL:
            full, held = 1, second
            continue
        out[n] = first
        n += 1
        if first != _LINE_END:
            if high == _FULL:
                full = 1
            else:
                out[n] = second
                n += 1
    return -1 if full > 0 or signal or command else n


@kernel
def _lay_out(characters: np.ndarray, out: np.ndarray, line: np.ndarray, word: np.ndarray) -> int:
    """Leave out padding and put spaces back; `line` is carried on. Return the new length."""
    n = 0
    previous, in_g_line = line[_PREVIOUS], line[_IN_G_LINE]
    for k in range(len(characters)):
        c = characters[k]
        if previous == _LINE_END:
            if c == _LINE_END:
                continue
            in_g_line = 1 if c == _G else 0
        elif in_g_line == 1 and word[c] and previous != _SPACE:
            out[n] = _SPACE
            n += 1
        out[n] = c
        n += 1
        previous = c
    line[_PREVIOUS], line[_IN_G_LINE] = previous, in_g_line
    return n


@kernel(inline=True)
def _signal(out: np.ndarray, n: int, command: int) -> int:
    out[n] = out[n + 1] = _SIGNAL
    out[n + 2] = command
    return n + 3


@kernel
def _pack(text: np.ndarray, out: np.ndarray, nibble: np.ndarray, is_word: np.ndarray) -> int:
    """Pack lines; return the number of bytes."""
    n = _signal(out, _signal(out, 0, _ENABLE), _NO_SPACES)
    packing = True
    start, length = 0, len(text)
    while start < length:
        end = start
        while end < length and text[end] != _LINE_END:
            end += 1
        stop = min(end + 1, length)
        # Comments hold other characters; an open line would be ended by the padding.
        wanted = text[start] != _SEMICOLON and end < length
        if wanted != packing and end > start:
            n = _signal(out, n, _ENABLE if wanted else _DISABLE)
            packing = wanted
        low = -1
        first = np.uint8(0)
        for k in range(start if end > start else stop, stop):
            c = text[k]
            if (
                c == _SPACE
                and text[start] == _G
                and text[k - 1] != _SPACE
                and k + 1 < stop
                and is_word[text[k + 1]]
            ):
                continue
            if not packing:
                out[n] = c
                n += 1
                continue
            code = int(nibble[c])
            if low < 0:
                low, first = code, c
                if c == _LINE_END:
                    out[n] = code << 4 | code
                    n += 1
                continue
            out[n] = code << 4 | low
            n += 1
            if low == _FULL:
                out[n] = first
                n += 1
            if code == _FULL:
                out[n] = c
                n += 1
            low = -1
        start = stop
    return n
