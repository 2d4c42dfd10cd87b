"""States of a localization over time."""

from __future__ import annotations

import numpy as np
import pytest

from spn_model.integrity.agreement import Agreement
from spn_model.integrity.fix import FixState


def states(events: str, step_s: float = 0.1, jump_m: float = 50.0) -> list[FixState]:
    """Return the state after each image: p a pose that follows, j one elsewhere, - none."""
    agreement, found, center = Agreement(), [], np.zeros(3)
    for k, event in enumerate(events):
        time_us = round(1e6 * (1 + step_s * k))
        if event == "-":
            found.append(agreement.failed(time_us))
            continue
        center = center + [0.5 * step_s, 0, 0] + (np.array([jump_m, 0, 0]) if event == "j" else 0)
        found.append(agreement.passed(time_us, center, np.eye(3), 0.01))
        if event == "j":
            center = center - [jump_m, 0, 0]
    return found


CONFIRM, TRACK, COAST, LOST, SEARCH = (
    FixState.CONFIRM,
    FixState.TRACK,
    FixState.COAST,
    FixState.LOST,
    FixState.SEARCH,
)


@pytest.mark.parametrize(
    ("events", "expected"),
    [
        ("pp", [CONFIRM, TRACK]),  # the second agrees with the first
        ("p-p", [CONFIRM, CONFIRM, TRACK]),  # two of three
        ("pjp", [CONFIRM, CONFIRM, TRACK]),
        ("--p", [SEARCH, SEARCH, CONFIRM]),
        ("pp-p", [CONFIRM, TRACK, COAST, TRACK]),
        ("ppjp", [CONFIRM, TRACK, COAST, TRACK]),  # one jump is not followed
        ("pp" + 12 * "-" + "pp", [CONFIRM, TRACK, *10 * [COAST], LOST, LOST, CONFIRM, TRACK]),
    ],
)
def test_states_follow_the_images(events, expected):
    """A pose is usable once two of three agree; a jump is not followed; after a second it is lost."""
    assert states(events) == expected
