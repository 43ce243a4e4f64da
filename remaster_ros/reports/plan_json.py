# SPDX-License-Identifier: Apache-2.0
"""A planned collection as JSON and as text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from remaster_ros.calibration.gauge_words import counted
from remaster_ros.kinematics.serial_chain import LEVER_M, SerialChain
from remaster_ros.planning.collection_plan import FITTED, CollectionPlan, Expected
from remaster_ros.planning.moving_design import MovingDesign
from remaster_ros.planning.moving_information import OWN_M
from remaster_ros.planning.planned_design import DesignSettings
from remaster_ros.planning.separating_design import DECIDED, SeparatingDesign
from remaster_ros.planning.tour_order import REFERENCE, REGISTRATION, Tour

HELD_OUT = 'validation'


def plan_to_dict(plan: CollectionPlan) -> dict[str, Any]:
    """Return the output of ``remaster plan --json``.

    ``robot_time_s`` is that of the whole session: registration, fitted and held-out poses, and
    references. ``dropped`` counts poses that lost all their solutions,
    ``dropped_configurations`` solutions. Prismatic joints are in ``expected_std_mm`` in place
    of ``expected_std_deg``. ``expected_tool_std_mm`` is the RMS 3-D error of the predicted
    markers.
    """
    visits = Counter(visit.split for visit in plan.visits)
    design = plan.design_result
    return {
        'configurations': len(plan.visits),
        'poses': sum(count for split, count in plan.poses.items() if split != REFERENCE),
        'dropped': dict(plan.tour.dropped),
        'robot_time_s': round(plan.robot_time_s, 1),
        **_expected_std(plan.joint_std, plan.tour.chain),
        'expected_tool_std_mm': plan.tool_rms * 1e3,
        'max_tool_speed_m_s': round(plan.max_tool_speed_m_s, 4),
        'splits': {
            split: {'poses': plan.poses[split], 'visits': count} for split, count in visits.items()
        },
        'dropped_configurations': plan.dropped,
        'expected_rms_std_deg': float(np.degrees(plan.joint_rms)),
        'goal': None
        if design is None
        else {
            'rms_std_deg': float(np.degrees(design.goal.joint_std_rad)),
            'tool_std_mm': design.goal.tool_std_m * 1e3,
            'tool_share': design.goal.tool_share,
            'reached': plan.goal_reached,
        },
        **(
            {}
            if plan.separating_design is None
            else {'separate': _separated(plan.separating_design)}
        ),
        **({} if plan.moving_design is None else {'moving': _moving(plan, plan.moving_design)}),
    }


def _moving(plan: CollectionPlan, design: MovingDesign) -> dict[str, Any]:
    """Return the key moving of a plan, on measuring in motion along curves.

    Durations of the curves, s; share of the time in which markers are in sight; largest joint and
    tool speeds; expected precision.
    """
    chain = plan.tour.chain
    joint, speed = design.max_joint_speed
    return {
        'moving_s': round(design.moving_s, 2),
        'curves_s': [round(curve.duration_s, 2) for curve in design.curves],
        'configurations': sum(len(end.way.points) for end in design.ends if end.way) + 1,
        'proof_poses': len(design.ends),
        'share_in_sight': round(design.share_in_sight, 4),
        'fastest_joint': chain.joint_names[joint],
        'max_joint_speed_deg_s': round(float(np.degrees(speed)), 2),
        'max_joint_share': round(design.max_joint_share, 4),
        'max_tool_speed_m_s': round(design.max_tool_speed_m_s, 4),
        'own_error_mm': 1e3 * OWN_M,
        'expected_rms_std_own_deg': float(np.degrees(design.own_rms)),
    }


def _separated(design: SeparatingDesign) -> dict[str, Any]:
    """Return the key separate of a plan: configurations that separate causes, and each pair.

    Configurations in degrees; of each pair how far apart the causes are without and with them,
    in standard deviations.
    """
    return {
        'configurations': sum(len(pose.solutions) for pose in design.poses),
        'q_deg': [
            np.degrees(q).round(4).tolist() for pose in design.poses for q in pose.solutions
        ],
        'pairs': [
            {
                'cause': pair.cause,
                'look_alike': pair.look_alike,
                'std_apart_before': round(pair.before, 2),
                'std_apart': round(pair.after, 2),
            }
            for pair in design.pairs
        ],
        'otherwise': list(design.otherwise),
    }


def _at_poses(configurations: int, poses: int) -> str:
    """Text such as '12 configurations at 3 poses'."""
    return f'{counted(configurations, "configuration")} at {counted(poses, "pose")}'


def plan_text(plan: CollectionPlan, settings: DesignSettings) -> str:
    """Return a plan as text, a subject a line: counts, time, expected precision, missed goal."""
    visits = Counter(visit.split for visit in plan.visits)
    poses = plan.poses
    if plan.moving_design is not None:
        return _moving_text(plan, plan.moving_design, settings)
    lines = [
        f'to fit: {_at_poses(visits[FITTED], poses.get(FITTED, 0))}'
        + (', chosen for what they tell' if settings.optimal else ' of a Latin hypercube'),
        f'held out: {_at_poses(visits[HELD_OUT], poses.get(HELD_OUT, 0))}',
    ]
    if visits[REGISTRATION]:
        lines.append(f'registration: {counted(visits[REGISTRATION], "configuration")}')
    if plan.tour.references:
        lines.append(
            f'references: {counted(plan.tour.references, "configuration")}, '
            f'{counted(visits[REFERENCE], "visit")}'
        )
    lines += [
        f'dropped poses: {_counts(plan.tour.dropped)}',
        f'dropped configurations: {_counts(plan.dropped)}',
        f'robot time of the whole session: {minutes_text(plan.robot_time_s)}, '
        f'fastest point at {plan.max_tool_speed_m_s:.2f} m/s',
    ]
    lines += _expected_lines(plan.tour.chain, plan.joint_std, plan.joint_rms, plan.tool_rms)
    if plan.separating_design is not None:
        lines += _separated_text(plan.separating_design)
    if missed := missed_goal(plan):
        lines.append(missed)
    return '\n'.join(lines)


def _moving_text(plan: CollectionPlan, design: MovingDesign, settings: DesignSettings) -> str:
    """Return a plan with curves (measured in motion) as text, one subject a line.

    Times, counts, speeds, expected precision, and the goal if it is missed.
    """
    visits, found = Counter(visit.split for visit in plan.visits), _moving(plan, design)
    lines = [
        f'to fit: {design.moving_s:.1f} s of motion, measured all along: '
        f'{counted(len(design.curves), "curve")} through '
        f'{counted(found["configurations"], "configuration")}, chosen for what they tell a second',
        f'held out: {_at_poses(visits[HELD_OUT], plan.poses.get(HELD_OUT, 0))}, measured at '
        'standstill; nothing is fitted on them',
    ]
    if visits[REGISTRATION]:
        lines.append(f'registration: {counted(visits[REGISTRATION], "configuration")}')
    if plan.unreached:
        lines.append(f'dropped configurations: {_counts(plan.dropped)}')
    lines += [
        f'robot time of the whole session: {plan.robot_time_s:.0f} s '
        f'({minutes_text(plan.robot_time_s)}), {design.moving_s:.0f} s of it measured motion',
        f'every marker in sight: {100.0 * design.share_in_sight:.0f} % of the measured motion',
        f'fastest joint: {found["fastest_joint"]} at {found["max_joint_speed_deg_s"]:.0f} deg/s; '
        f'joints use at most {100.0 * design.max_joint_share:.0f} % of their speeds',
        f'fastest point: {design.max_tool_speed_m_s:.2f} m/s in measured motion, '
        f'{plan.max_tool_speed_m_s:.2f} m/s at all',
    ]
    lines += _expected_lines(plan.tour.chain, plan.joint_std, plan.joint_rms, plan.tool_rms)
    lines.insert(
        -1,
        f'  {"":20s} {np.degrees(design.own_rms):.4f} deg if each marker errs by '
        f'{1e3 * OWN_M:g} mm by itself, too',
    )
    goal = settings.joint_std_rad
    if goal is not None and plan.joint_rms > goal:
        needed = design.moving_s * (plan.joint_rms / goal) ** 2
        lines.append(
            f'not reached: poses.joint_std_deg {np.degrees(goal):.4f}; some {needed:.0f} s of '
            f'motion would (--moving {np.ceil(needed):.0f})'
        )
    return '\n'.join(lines)


def outlook_to_dict(tour: Tour, expected: Expected) -> dict[str, Any]:
    """Return a plan before paths are planned as a dict: keys of `plan_to_dict` that need no paths.

    Its splits have 'configurations' in place of 'visits'. ``expected``: expected precision.
    """
    return {
        'configurations': sum(tour.configurations.values()),
        'poses': sum(tour.poses.values()),
        'dropped': dict(tour.dropped),
        'dropped_configurations': dict(tour.dropped_solutions),
        **_expected_std(expected.joint_std, tour.chain),
        'expected_tool_std_mm': expected.tool_rms * 1e3,
        'splits': {
            split: {'poses': poses, 'configurations': tour.configurations[split]}
            for split, poses in tour.poses.items()
        },
    }


def outlook_text(tour: Tour, expected: Expected) -> str:
    """A plan before paths are planned as text, a subject a line: counts and expected precision."""
    counts = {split: (tour.configurations[split], poses) for split, poses in tour.poses.items()}
    fitted, held_out = counts[FITTED], counts.get(HELD_OUT, (0, 0))
    lines = [
        f'to fit: {_at_poses(*fitted)}',
        f'held out: {_at_poses(*held_out)}',
        f'dropped poses: {_counts(tour.dropped)}',
    ]
    return '\n'.join([*lines, *_expected_lines(tour.chain, *expected)])


def _expected_lines(
    chain: SerialChain, joint_std: Mapping[str, float | None], joint_rms: float, tool_rms: float
) -> list[str]:
    """Expected standard deviations, a line each: of the offsets, their RMS, and of the markers.

    ``joint_std``: rad or m, None if not identifiable; ``joint_rms``: rad; ``tool_rms``: m.
    """
    lines = ['expected standard deviation of the offsets:']
    for joint, (name, std) in enumerate(joint_std.items()):
        value = 'not identifiable' if std is None else chain.shown_offset(joint, std, 4)
        lines.append(f'  {name:20s} {value}')
    return [
        *lines,
        f'  {"root mean square":20s} {np.degrees(joint_rms):.4f} deg{slides_in_rms(chain)}',
        f'expected error of the predicted markers: {tool_rms * 1e3:.3f} mm (RMS)',
    ]


def slides_in_rms(chain: SerialChain) -> str:
    """Remark how prismatic joints count in an RMS in degrees; '' if there are none."""
    per_degree = 1e3 * np.radians(LEVER_M)
    return f', where {per_degree:.2f} mm count as a degree' if chain.slides.any() else ''


def _expected_std(
    joint_std: Mapping[str, float | None], chain: SerialChain
) -> dict[str, dict[str, float | None]]:
    """Expected standard deviations in degrees, and in mm for prismatic joints, by joint.

    ``joint_std``: rad or m, in joint order; None stays None.
    """
    found: dict[str, dict[str, float | None]] = {'expected_std_deg': {}}
    if chain.slides.any():
        found['expected_std_mm'] = {}
    for (name, std), unit, scale in zip(joint_std.items(), chain.shown_units, chain.shown_scale):
        found[f'expected_std_{unit}'][name] = None if std is None else float(scale) * std
    return found


def _separated_text(design: SeparatingDesign) -> list[str]:
    """Return lines on the configurations of a plan that separate causes.

    Their number; a line for each pair of causes, with how far apart these are, in standard
    deviations, and whether that decides between them; then what poses do not separate.
    """
    count = sum(len(pose.solutions) for pose in design.poses)
    lines = [f'of these to separate causes: {_at_poses(count, len(design.poses))}']
    for pair in design.pairs:
        verdict = 'decided' if pair.after >= DECIDED else 'may stay open'
        lines.append(
            f'  {pair.cause} or {pair.look_alike}: {pair.after:.1f} standard deviations apart '
            f'({pair.before:.1f} without them), {verdict}'
        )
    lines += [f'  poses do not separate {words}' for words in design.otherwise]
    return lines


def minutes_text(seconds: float) -> str:
    """Time, s, in minutes as text: '12.5 min'."""
    return f'{seconds / 60:.1f} min'


def missed_goal(plan: CollectionPlan) -> str:
    """Return a sentence that a plan's optimal design misses its goal of precision, with remedy.

    '' if it reaches the goal, or if the plan was not made by an optimal design.
    """
    if plan.design_result is None or plan.goal_reached:
        return ''
    return (
        f'not reached: {plan.design_result.goal.describe()}, with the poses that a search for '
        'causes needs; wider ranges under poses, further values in held_values_deg or a longer '
        'lever of the marker would help'
    )


def _counts(counts: dict[str, int] | Counter[str]) -> str:
    """Counts by reason as text, the largest first: '3 a, 1 b'; 'none' without any."""
    ordered = Counter(counts).most_common()
    return ', '.join(f'{count} {reason}' for reason, count in ordered) or 'none'
