# SPDX-License-Identifier: Apache-2.0
"""Page of a planned collection: the arm in 3-D with all paths and configurations, and figures.

The page is self-contained: nothing is fetched when it is opened.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.calibration.gauge_words import counted
from remaster_ros.collection.plan_confirmation import service_name
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.motion.trajectory import RAMP_S, REST_S, Trajectory
from remaster_ros.planning.collection_plan import FITTED, CollectionPlan
from remaster_ros.planning.moving_information import OWN_M
from remaster_ros.planning.tour_order import REFERENCE, REGISTRATION
from remaster_ros.reports.plan_json import HELD_OUT, minutes_text, missed_goal, slides_in_rms
from remaster_ros.reports.robot_scene import RobotScene
from remaster_ros.reports.scene_view import scene_to_dict, view_script
from remaster_ros.session.files import make_folder, undone_on_failure, write_atomically
from remaster_ros.version import __version__

GENERATOR = 'remaster plan'
HEAD_BYTES = 2000
"""Length of the head that identifies the page, bytes."""
LARGEST_PAGE = 50_000_000
SAMPLE_S = 0.05
"""Time between two samples of a curve, s: at some rad/s² chords are within a milliradian of it."""
_MARK = f'<meta name="generator" content="{GENERATOR}">'.encode()
WORDS = {
    REGISTRATION: ('for the registration', 'the first three that are seen register the sensors'),
    FITTED: ('to fit', 'the offsets are fitted on these'),
    HELD_OUT: ('held out', 'the gain is proved on these, which nothing is fitted on'),
    REFERENCE: ('references', 'measured again and again, so that what moves meanwhile is seen'),
}


def plan_page(
    plan: CollectionPlan,
    scene: RobotScene,
    cell: str,
    *,
    registered: bool = False,
    confirm: str = '',
) -> str:
    """Return the HTML of a plan's page.

    Parameters
    ----------
    plan
        The planned collection.
    scene
        The arm and its surroundings.
    cell
        Name of the cell.
    registered
        Whether the sensors are drawn at their measured positions, not at rough ones.
    confirm
        Name of the plan if the arm waits for its confirmation; '' otherwise.
    """
    # Only here: it brings the libraries of figures.
    from remaster_ros.reports.pages import compressed, page

    minutes = minutes_text(plan.robot_time_s)
    poses = sum(count for split, count in plan.poses.items() if split != REFERENCE)
    moving_s = plan.robot_time_s - plan.measuring_s * len(plan.visits)
    fastest = max(range(len(plan.visits)), key=lambda i: plan.visits[i].tool_speed_m_s)
    in_motion = ''
    if plan.moving_design is not None:
        in_motion = (
            f'{plan.moving_design.moving_s:.1f} s of motion along '
            f'{counted(len(plan.moving_design.curves), "curve")} are measured all along, with '
            f'every marker in sight for {100.0 * plan.moving_design.share_in_sight:.0f} % of '
            f'them; the offsets are fitted on these. If each marker errs by {1e3 * OWN_M:g} mm by '
            'itself, too, the expected standard deviation is '
            f'{np.degrees(plan.moving_design.own_rms):.4f} degrees'
        )
    return page(
        'plan.html.jinja',
        generator=GENERATOR,
        robot=scene.chain.name,
        cell=cell,
        registered=registered,
        confirm=confirm,
        confirm_service=service_name(confirm),
        mood='caution' if missed_goal(plan) or plan.undetermined else 'good',
        headline=(
            f'{len(plan.visits)} configurations at {poses} poses in {minutes} of robot time for '
            f'the whole session; no '
            f'point of arm and tool faster than {plan.max_tool_speed_m_s:.2f} m/s.'
        ),
        moving=minutes_text(moving_s),
        in_motion=in_motion,
        measuring_s=f'{plan.measuring_s:g}',
        fastest=fastest + 1,
        undetermined=plan.undetermined,
        points=_points(plan),
        sensors=[
            (number, sight.sensor)
            for number, sight in enumerate(scene.sights)
            if sight.sensor not in [other.sensor for other in scene.sights[:number]]
        ],
        notes=scene.notes,
        splits=_splits(plan),
        visits=len(plan.visits),
        dropped=_dropped(plan),
        joints=_joints(plan, scene.chain),
        rms_deg=float(np.degrees(plan.joint_rms)),
        slides_in_rms=slides_in_rms(scene.chain),
        tool_mm=1e3 * plan.tool_rms,
        version=__version__,
        data=compressed(json.dumps(_played(plan, scene), separators=(',', ':'), allow_nan=False)),
        code=compressed(view_script('plan_page.js')),
    )


def check_plan_page(path: Path) -> None:
    """Raise InputError if a file exists and is no page of a plan.

    A page of a plan has the mark of `GENERATOR` in its first 2,000 bytes.
    """
    if not path.exists():
        return
    if path.is_file():
        with path.open('rb') as file:
            if _MARK in file.read(HEAD_BYTES):
                return
    raise InputError(f'{path}: already there, and no page of {GENERATOR}; give another name')


def read_plan_page(path: Path, plan: str) -> bytes:
    """Read the page of a plan from a file, as bytes.

    Parameters
    ----------
    path
        The file; its name may come from the network, so no other content is returned.
    plan
        Fingerprint of the plan.

    Raises
    ------
    InputError
        There is no such page, or it shows another plan.
    """
    try:
        if not path.is_file() or path.stat().st_size > LARGEST_PAGE:
            raise InputError(f'{path} is not on this computer')
        html = path.read_bytes()
    except OSError as error:
        raise InputError(f'{path}: {error.strerror}') from None
    head = html[:HEAD_BYTES]
    if _MARK not in head or f'<meta name="plan" content="{plan}">'.encode() not in head:
        raise InputError(f'{path} shows another plan')
    return html


def write_plan_page(path: Path, html: str) -> None:
    """Write the HTML of a plan's page to a file; of existing files only such a page is replaced.

    Raises
    ------
    InputError
        Another file is there, or it cannot be written.
    """
    check_plan_page(path)
    with undone_on_failure():
        make_folder(path.parent)
        write_atomically(path, html)


def _points(plan: CollectionPlan) -> list[str]:
    """Return warnings on a plan as sentences, [] if there are none.

    On a missed goal, an undetermined fit, and configurations that no path reaches.
    """
    points = [missed_goal(plan)]
    if plan.undetermined:
        points.append(f'A fit of these configurations states nothing: {plan.undetermined}')
    if plan.unreached:
        points.append(f'No free way leads to {plan.unreached} configurations: they are left out')
    return [point for point in points if point]


def _splits(plan: CollectionPlan) -> list[dict[str, Any]]:
    """Return a row for each split that has visits: words and counts, in the order of `WORDS`."""
    rows = []
    for split, (words, why) in WORDS.items():
        visits = [visit for visit in plan.visits if visit.split == split]
        if visits:
            poses = plan.poses[split]
            if split == FITTED and plan.moving_design is not None:
                why = 'where the first curve begins; the offsets are fitted on the curves'
            rows.append(
                {'split': split, 'words': words, 'why': why, 'poses': poses, 'visits': len(visits)}
            )
    return rows


def _dropped(plan: CollectionPlan) -> dict[str, tuple[int, int]]:
    """Return the numbers of dropped poses and configurations, reason -> (poses, configurations).

    The most frequent reason, by the larger of the two, first.
    """
    poses, solutions = plan.tour.dropped, plan.dropped
    counts = {
        name: (poses.get(name, 0), solutions.get(name, 0)) for name in {**poses, **solutions}
    }
    return dict(sorted(counts.items(), key=lambda item: -max(item[1])))


def _joints(plan: CollectionPlan, chain: SerialChain) -> list[dict[str, Any]]:
    """Return expected std, range over the visits, and limits of each joint, deg or mm."""
    q = chain.shown_scale * np.array([visit.q for visit in plan.visits])
    return [
        {
            'name': f'{name} (mm)' if chain.slides[joint] else name,
            'std': None if std is None else float(chain.shown_scale[joint] * std),
            'low': float(q[:, joint].min()),
            'high': float(q[:, joint].max()),
            'limits': _limits(chain, joint),
        }
        for joint, name in enumerate(chain.joint_names)
        for std in (plan.joint_std.get(name),)
    ]


def _limits(chain: SerialChain, joint: int) -> str:
    """Limits of a joint (index from 0) as text, degrees or mm; 'none' if one is infinite."""
    if not np.isfinite([chain.lower[joint], chain.upper[joint]]).all():
        return 'none'
    return chain.shown_limits(joint).replace('-', '\N{MINUS SIGN}')


def _played(plan: CollectionPlan, scene: RobotScene) -> dict[str, Any]:
    """Data that plan_page.js plays: joint positions in rad and m, times in s."""
    return {
        'scene': scene_to_dict(scene),
        'start': _rounded(plan.visits[0].points[0]),
        'ramp_s': RAMP_S,
        'rest_s': REST_S,
        'measuring_s': plan.measuring_s,
        'words': {split: words for split, (words, _) in WORDS.items()},
        'visits': [
            {
                'split': visit.split,
                'pose': visit.pose,
                **_way(visit.trajectory),
                'speed': round(visit.tool_speed_m_s, 4),
            }
            for visit in plan.visits
        ],
    }


def _way(trajectory: Trajectory) -> dict[str, Any]:
    """Return the path of a trajectory as plan_page.js plays it.

    Of straight lines 'way', the corners after the first, and 'rates', one for each line; of a
    curve 'way', samples of it, and 'times' of these, s.
    """
    if trajectory.is_curve:
        times = np.append(
            np.arange(SAMPLE_S, trajectory.duration_s, SAMPLE_S), trajectory.duration_s
        ).tolist()
        return {
            'way': [_rounded(trajectory.at(time_s)[0]) for time_s in times],
            'times': [round(time_s, 3) for time_s in times],
        }
    return {
        'way': [_rounded(q) for q in trajectory.points[1:]],
        'rates': [round(line.rate, 6) for line in trajectory.lines],
    }


def _rounded(q: Any) -> list[float]:
    """Joint positions as a list, to five decimals."""
    return [round(float(angle), 5) for angle in q]
