"""Words of the keys exclude.gyro and exclude.accel."""

from __future__ import annotations

import math

import numpy as np
import pytest

from haltere.errors import UsageError
from haltere.flight import config
from haltere.flight.exclusion import exclusion_table, exclusion_text


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("off", []),
        ("xyz@20-80", [(7, 20.0, 80.0)]),
        ("x@10,yz@30.5-40", [(1, 10.0, math.inf), (6, 30.5, 40.0)]),
        (" z ", [(4, -math.inf, math.inf)]),
    ],
)
def test_spans(text: str, rows: list[tuple[float, float, float]]) -> None:
    want = np.zeros((4, 3))
    want[: len(rows)] = np.array(rows).reshape(-1, 3)
    assert np.array_equal(exclusion_table(text), want)


@pytest.mark.parametrize("text", ["", "on", "w@1-2", "xx@1-2", "x@5-5", "x@8-2", "x@a-b", "x@1-2;y", "x@1..2-3", "x@1,x@2,x@3,x@4,x@5"])
def test_other_words_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="key exclude"):
        exclusion_text(text, "key exclude.gyro")


def test_the_key_keeps_its_words_and_says_where_it_is_wrong() -> None:
    assert config.KEYS["exclude.gyro"].default == "off"
    assert config._check("exclude.gyro", "x@1, yz@2-3", "--set") == "x@1,yz@2-3"
    with pytest.raises(UsageError, match=r"exclude\.accel"):
        config._check("exclude.accel", "all", "--set")


def test_an_estimator_without_a_vehicle_model_says_that_it_has_no_such_key() -> None:
    with pytest.raises(UsageError, match=r"exclude\.gyro"):
        config.resolve("ahrs", "default", {"exclude.gyro": "x@1-2"})
