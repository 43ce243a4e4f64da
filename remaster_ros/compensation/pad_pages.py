# SPDX-License-Identifier: Apache-2.0
"""Pages for re-mastering on makers' pads, and motor numbers that controllers store."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from remaster_ros.compensation.export import REMASTER_FILE, ZeroOffsets
from remaster_ros.kinematics.pad_angles import PadAngles

_BEFORE = f"""The angles are those of {REMASTER_FILE}: offset is what the true angle is above
the reported one, in degrees; drive each joint until the pad shows `drive to`, and make that
place show `set to`.
"""
_NEVER = """**Nothing on this page was tried on a controller by its authors.** Read the
manual of your controller's version first, save a backup, and write down the present values.
Taught programs, tool and work objects were made with the old zeros and move by the correction.
"""
_UNDO = 'Undo: enter the values that you wrote down, or load the backup.'

PAD_PAGES: Mapping[str, str] = {
    'pad_kuka.md': f"""# KUKA (KR C)

{_NEVER}
{_BEFORE}
First: is `$ABS_ACCUR` as it was when the session was measured (`#ACTIVATED`, `#SUPPRESSED` or
`#NONE`; TRUE or FALSE in KSS 5)? The offsets belong to that state alone.

- Where: Start-up → Master → *Reference*, joint by joint. The mastering position is not 0
  (machine data `$MAMES`): drive to it plus (`drive to` - `set to`).
- Sign and unit: degrees, as the pad shows them.
- Coupled axes: none that is seen on the pad.
- {_UNDO} Mastering with the EMD afterwards undoes it too, since it finds the notch again.
- Compared with: *Operating Handbook KR C2: Machine Data* (at the mechanical zero the counter
  is set to `$MAMES`). Not checked: the menu. For an LBR iiwa use another form.
""",
    'pad_abb.md': f"""# ABB (IRC5, OmniCore)

{_NEVER}
{_BEFORE}
First: is Absolute Accuracy on or off as it was when the session was measured? The offsets
belong to that state alone.

- Where: Calibration → the mechanical unit → Calibration parameters → *Fine calibration* of
  that joint alone, in its place. *Update revolution counters* is another function and does
  not change the zero.
- Sign and unit: drive by the angles that the pad shows. No new motor calibration offset is
  computed here: nothing public states its sign and unit.
- Coupled axes: joints 2 and 3 of some arms (IRB 2400) are coupled in the ROS driver.
- {_UNDO} The old values are in Calibration parameters → *Edit motor calibration offset*.
- Compared with: articles of others alone. Not checked: anything by the maker; the names of
  the menus.
""",
    'pad_fanuc.md': f"""# FANUC

{_NEVER}
{_BEFORE}
- Where: Menu → System → Master/Cal → *Single axis master*: enter `set to` (else 0) as master
  position of the joint, select it and execute, then *Calibrate*.
- Sign and unit: degrees, as the pad shows them.
- Coupled axes: joint 3 is counted from the horizontal. Import with `--couple J3=J2`; drive
  both joints first, master joint 2, then joint 3 without a move between.
- {_UNDO} The old counts are in `$DMR_GRP[1].$MASTER_COUN`. By an article, position =
  (encoder count - master count) × scale: the reported angle grows as the master count falls
  (direction -1).
- Compared with: articles of others alone. Not checked: anything by the maker; the horizontal
  joint 3.
""",
    'pad_yaskawa.md': f"""# Yaskawa

{_NEVER}
{_BEFORE}
- Where: Robot → *Home position* → that axis, in its place.
- Sign and unit: drive by the angles that the pad shows; the window itself counts pulses.
- Coupled axes: not known. Check that no other joint's angle changes when one is set.
- {_UNDO} The old pulse counts are in the same window.
- Compared with: articles of others alone. Not checked: anything by the maker.
""",
}


@dataclass(frozen=True)
class MotorNumber:
    """Number that a controller has stored for a joint's motor, and how the angle follows it."""

    old: float  # The stored number
    counts_per_degree: float  # Counts per degree of the joint, above 0
    direction: int  # 1 if the reported angle grows with the stored number, -1 if it falls


def motor_text(offsets: ZeroOffsets, motors: Mapping[str, MotorNumber]) -> str:
    """Text with the motor numbers to store: new = old + direction × counts per degree × offset.

    ``motors``: by joint; joints without one are left out. Joints that slide, are coupled or
    not determined have the reason in place of a number.
    """
    pad = PadAngles.of(offsets.controller, offsets.chain.joint_names)
    shown = np.degrees(pad.offsets_on_pad(offsets.applied))
    lines = [
        'What the controller has stored of motors, so that the reported angle of a joint grows by',
        'its offset: new = old + direction x counts per degree x offset, with your numbers. Never',
        'tried on a controller: write down the old numbers, and see that the pad then shows "set',
        f'to" in the place of {REMASTER_FILE}. In place of setting the joint, never after it.',
        '',
    ]
    for i, name in enumerate(offsets.chain.joint_names):
        motor = motors.get(name)
        if motor is None:
            continue
        coupled = pad.coupled(i) or any(i in pad.coupled(j) for j in range(len(shown)))
        if offsets.chain.slides[i] or coupled or not offsets.identifiable[i]:
            why = 'it is coupled to another joint' if coupled else 'it is not determined'
            why = 'it slides, and counts are per degree' if offsets.chain.slides[i] else why
            lines.append(f'{name}: no number, since {why}')
            continue
        new = motor.old + motor.direction * motor.counts_per_degree * shown[i]
        lines.append(
            f'{name}: old {motor.old:.10g}, offset {shown[i]:+.4f} deg, '
            f'{motor.counts_per_degree:.10g} counts per degree, direction {motor.direction:+d}: '
            f'new {new:.3f}'
        )
    return '\n'.join([*lines, ''])
