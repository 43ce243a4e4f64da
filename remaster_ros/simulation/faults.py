# SPDX-License-Identifier: Apache-2.0
"""Faults for the fakes: a file in the hidden World, written by a test.

``faults.json`` maps a device (``robot`` or a sensor's name) to its faults, and each fault to its
number: ``{"robot": {"slow": 3.0}, "mocap": {"frozen": 1}}``. The fakes read it continuously, so
that a fault begins and ends with the file.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path

from remaster_ros.errors import InputError, did_you_mean

Numbers = Mapping[str, float]
FILE = 'faults.json'
# What the fakes know, and what each does with its number.
# The robot:
OF_ROBOT = {
    'off': 'reports nothing and takes no command',
    'dropped': 'takes no command',
    'estop': 'stands still at once and takes no command',
    'estop_reported': 'the same, and its safety circuit reports it',
    'elsewhere': 'goes so many rad beside its target, at every joint (a slide 0.25 m for each)',
    'slow': 'needs so many times as long',
    'late': 'reports what was so many seconds ago',
    'intermittent': 'is off every other period of so many seconds',
    'nan': 'reports a joint that is not a number',
    'renamed': 'reports joints of other names',
    'reordered': 'reports the joints in another order each time',
    'drift': 'creeps to and fro by so many rad',
    'copy': 'reports what was commanded',
    'clock': 'has a clock that is off by so many seconds',
    'lost': 'every n-th report arrives, the others are lost',
    'doubled': 'sends every report twice',
    'repeated': 'sends the last report again and again, with its old stamp',
    'frozen': 'reports where it was when the fault began, with new stamps',
    'wrapped': 'reports the joint of this number (from 1) a turn too far',
    'wrapped_once': 'the same, in one report',
}
# An OptiTrack server:
OF_OPTITRACK = {
    'off': 'neither streams nor answers',
    'stopped': 'answers, but does not stream',
    'frozen': 'streams new frames with old positions',
    'swapped': 'labels a stray as the marker',
    'jumping': 'shows the marker half a metre off in every fourth frame',
    'occluded': 'does not see the marker',
    'hidden': 'does not see the marker of this number in the rigid body',
    'exchanged': 'takes the marker of this number for the first one, and the other way round',
    'filled': 'guesses where the marker is',
    'slow': 'streams every n-th frame',
    'late': 'streams frames so many seconds late',
    'intermittent': 'does not see the marker every other period of so many seconds',
    'garbage': 'streams random bytes',
    'duplicate': 'sends every frame twice',
    'reordered': 'sends every second frame before the first',
    'renumbered': 'begins the frame numbers and the time anew, once',
    'bumped': 'has been moved by so many metres, across its line of sight',
}
# A laser tracker:
OF_TRACKER = {
    'off': 'refuses connections and drops its client',
    'stuck': 'answers nothing',
    'swapped': 'measures another reflector, so many metres beside',
    'slow': 'needs so many times as long for everything',
    'garbage': 'sends random bytes',
    'cut': 'breaks off each packet after so many bytes',
    'intermittent': 'loses the beam every other period of so many seconds',
    'occluded': 'sees no reflector',
    'hidden': 'does not see the reflector of this number',
    'renumbered': 'has been switched off and on, once',
    'bumped': 'has been moved by so many metres, across its line of sight',
}


def inject(folder: Path, faults: Mapping[str, Numbers]) -> None:
    """Write the faults of the World in `folder`, in place of all former ones; {} ends all.

    ``faults``: device ('robot' or a sensor) -> fault -> its number. Raises InputError for a
    fault that such a device cannot have; then nothing is written.
    """
    for device, numbers in faults.items():
        known = OF_ROBOT if device == 'robot' else OF_OPTITRACK | OF_TRACKER
        for name in numbers:
            if name not in known:
                raise InputError(
                    f"there is no fault '{name}' of {device}; there are {', '.join(known)}"
                    f'{did_you_mean(name, known)}'
                )
    temporary = folder / f'{FILE}.new'
    temporary.write_text(json.dumps(faults))
    os.replace(temporary, folder / FILE)


class Faults:
    """Present faults of the devices of a World, read from the file that `inject` writes."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / FILE
        self._read_at: int | None = None
        self._faults: Mapping[str, Numbers] = {}

    def of(self, device: str) -> Numbers:
        """Present faults of a device, fault -> number; {} if it has none or there is no file.

        The file is read again whenever it has changed.
        """
        try:
            changed = self._path.stat().st_mtime_ns
        except OSError:
            return {}
        if changed != self._read_at:
            self._faults, self._read_at = json.loads(self._path.read_text()), changed
        return self._faults.get(device, {})


def in_outage(period_s: float | None, t: float) -> bool:
    """Whether a device that fails in every second period of ``period_s`` fails at time t, s.

    It works in the first period, from 0 on. Never with a period of None or 0.
    """
    return bool(period_s) and int(t / period_s) % 2 == 1  # type: ignore[operator]
