# SPDX-License-Identifier: Apache-2.0
"""Write a correction in the form of a controller or driver, or its registrations for tf."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np

from remaster_ros.cli.console import tell
from remaster_ros.compensation.controller_forms import FORMS, exported, form_content
from remaster_ros.compensation.file import Compensation, read_compensation
from remaster_ros.compensation.pad_pages import MotorNumber
from remaster_ros.compensation.static_transforms import (
    LAUNCH_FILE,
    TF,
    static_transforms,
    transform_files,
)
from remaster_ros.errors import InputError
from remaster_ros.session.files import (
    URDF_LIMIT,
    decode_text,
    make_new_folder,
    read_limited,
    undone_on_failure,
    write_atomically,
)

FORMAT = 'remaster-export/1'
LEFT_OUT_FILE = 'left_out.txt'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster export``."""
    parser.add_argument(
        'compensation', metavar='COMPENSATION', type=Path, help='apply/compensation.json'
    )
    parser.add_argument(
        '--to',
        choices=(*FORMS, TF),
        required=True,
        help='urdf; ur: kinematics file of a Universal Robots arm; ros2_control: offsets of '
        'transmissions; rising: calibration of the URDF; pad: what to set by hand; json, csv: DH, '
        'Hayati and POE; tf: static transforms of the sensors, a launch file and a YAML',
    )
    parser.add_argument('--out', metavar='DIR', type=Path, required=True, help='a new folder')
    parser.add_argument(
        '--base',
        metavar='FILE',
        type=Path,
        help="what is changed: the arm's own kinematics file (ur), a URDF (ros2_control, rising; "
        'default: the nominal one)',
    )
    parser.add_argument(
        '--driver-param',
        action='store_true',
        help='ros2_control: <param name="offset"> for drivers that report raw angle - offset',
    )
    parser.add_argument(
        '--motor',
        metavar='JOINT=OLD,COUNTS,DIRECTION',
        type=_motor,
        action='append',
        default=[],
        help='pad: a number that the controller has stored of a motor, counts per degree, and 1 '
        'or -1 as the reported angle grows or falls with it; may be repeated',
    )
    parser.add_argument(
        '--frame',
        metavar='SENSOR=FRAME',
        type=_frame,
        action='append',
        default=[],
        help="tf: the sensor's frame where it has not the sensor's name; may be repeated",
    )
    parser.add_argument('--json', action='store_true', help='print what was done as JSON')


def _motor(text: str) -> tuple[str, MotorNumber]:
    """Argument type: a joint and the numbers of its motor, JOINT=OLD,COUNTS,DIRECTION.

    They are the number stored in the controller, counts per degree, and 1 or -1. Raises
    ArgumentTypeError for another form, counts not above 0, or another direction.
    """
    name, _, values = text.partition('=')
    parts = values.split(',')
    try:
        old, counts = (float(part) for part in parts[:2])
        direction = int(parts[2]) if len(parts) == 3 else 0
    except ValueError:
        old, counts, direction = np.nan, np.nan, 0
    if not (name and np.isfinite(old) and 0.0 < counts < np.inf and direction in (1, -1)):
        raise argparse.ArgumentTypeError(
            f'{text!r} is not JOINT=OLD,COUNTS_PER_DEGREE,DIRECTION, such as '
            'joint_2=123456,1137.8,-1'
        )
    return name, MotorNumber(old, counts, direction)


def _frame(text: str) -> tuple[str, str]:
    """Argument type: a sensor and its frame, SENSOR=FRAME; ArgumentTypeError for another form."""
    sensor, _, frame = text.partition('=')
    if not (sensor and frame):
        raise argparse.ArgumentTypeError(f'{text!r} is not SENSOR=FRAME, such as mocap=bar_link')
    return sensor, frame


def run(args: argparse.Namespace) -> int:
    """Write a correction in a form, and print what that form leaves out; return 0.

    Raises InputError for options that the form does not have, unknown joints, an invalid file,
    and a folder that is not new.
    """
    for given, forms, option in (
        (args.base, ('ur', 'ros2_control', 'rising'), '--base'),
        (args.driver_param, ('ros2_control',), '--driver-param'),
        (args.motor, ('pad',), '--motor'),
        (args.frame, (TF,), '--frame'),
    ):
        if given and args.to not in forms:
            raise InputError(f'{option} goes with --to {" or ".join(forms)}; leave it out')
    compensation = read_compensation(args.compensation)
    if args.to == TF:
        return _transforms(args, compensation)
    names = compensation.compensator.joint_names
    motors = dict(args.motor)
    for name in motors:
        if name not in names:
            raise InputError(
                f'--motor: {name!r} is not among the joints ({", ".join(names)}); correct the name'
            )
    base = None
    if args.base is not None:
        data = read_limited(args.base, URDF_LIMIT, 'name the file that is to be changed')
        base = args.base, decode_text(data, args.base)
    form = form_content(compensation, args.to, np.random.default_rng(args.seed))
    files = exported(
        compensation, args.to, form, base, driver_param=args.driver_param, motors=motors
    )
    files[LEFT_OUT_FILE] = '\n'.join([*form.words, ''])
    _write(args.out, files)
    content = {
        'format': FORMAT,
        'form': args.to,
        'files': list(files),
        'left_out': {
            'rms_mm': form.rms_mm,
            'max_mm': form.max_mm,
            'parts': [asdict(part) for part in form.parts],
            'corrected_in_no_form': [entry.effect for entry in form.uncorrectable],
        },
    }
    tell(args, content, *form.words, f'written: {args.out} ({", ".join(files)})')
    return 0


def _transforms(args: argparse.Namespace, compensation: Compensation) -> int:
    """Write the registrations for tf, with a launch file that publishes them; return 0.

    Raises InputError for an unknown sensor of --frame.
    """
    transforms = static_transforms(compensation, dict(args.frame))
    files = transform_files(transforms)
    _write(args.out, files)
    content = {
        'format': FORMAT,
        'form': TF,
        'files': list(files),
        'transforms': [asdict(transform) for transform in transforms],
    }
    tell(
        args,
        content,
        *(transform.words for transform in transforms),
        'Right with the whole correction in use, and where no other node publishes these frames.',
        f'to publish: ros2 launch {args.out / LAUNCH_FILE}',
        f'written: {args.out} ({", ".join(files)})',
    )
    return 0


def _write(folder: Path, files: Mapping[str, str]) -> None:
    """Write files, name -> text, into a new folder; InputError if it is not new.

    The folder is removed again if that fails.
    """
    with undone_on_failure():
        make_new_folder(folder)
        for name, text in files.items():
            write_atomically(folder / name, text)
