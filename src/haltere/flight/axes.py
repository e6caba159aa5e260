"""Three letters for where a sensor's x, y and z point in the body, and the matrix they stand for. It turns nothing itself."""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numpy.typing import NDArray

__all__ = ["WORDS", "matrix", "word"]

#: Axis of the body (forward, right, down) and sign by letter.
_LETTERS = {"F": (0, 1.0), "B": (0, -1.0), "R": (1, 1.0), "L": (1, -1.0), "D": (2, 1.0), "U": (2, -1.0)}


def matrix(word: str) -> NDArray[np.float64]:
    """Matrix (3, 3) that takes a sensor's x, y, z to the body's forward, right, down: ``v_b = matrix(word) @ v_sensor``.

    ``FLU`` is ``diag(1, -1, -1)``. A word whose matrix has determinant -1 is a mirrored triad.
    """
    out = np.zeros((3, 3))
    for column, letter in enumerate(word):
        axis, sign = _LETTERS[letter]
        out[axis, column] = sign
    return out


def word(turn: NDArray[np.float64]) -> str:
    """Word of a signed permutation matrix; the inverse of `matrix`."""
    letters = ("FB", "RL", "DU")
    rows = np.argmax(np.abs(turn), axis=0)
    return "".join(letters[int(row)][int(turn[row, column] < 0.0)] for column, row in enumerate(rows))


def _words() -> tuple[str, ...]:
    every = ["".join(letters) for letters in permutations(_LETTERS, 3) if len({_LETTERS[c][0] for c in letters}) == 3]
    return tuple(sorted(every, key=lambda w: (float(np.linalg.det(matrix(w))) < 0.0, w != "FRD")))


#: All 48: the 24 turned triads, then the 24 mirrored ones; FRD, which changes nothing, is the first.
WORDS = _words()
