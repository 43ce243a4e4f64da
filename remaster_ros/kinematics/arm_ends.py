# SPDX-License-Identifier: Apache-2.0
"""The likely base and tool links of the arm in a robot description."""

from __future__ import annotations

from collections.abc import Container

from remaster_ros.errors import InputError
from remaster_ros.kinematics.urdf import UrdfJoint, UrdfModel

# Frames of a tool plate by the names that makers and ROS-Industrial give them, best first.
TOOL_NAMES = (
    *('tool0', 'tool', 'tcp', 'tool_link', 'tool_frame', 'tool_center_point', 'tool_tip'),
    *('link_ee', 'ee_link', 'link_eef', 'eef', 'ee', 'end_effector', 'flange', 'hand'),
)
_WORLD = ('world', 'map', 'odom')
# Words for parts of a gripper in the names of joints and of their child links.
_JAWS = ('finger', 'jaw', 'knuckle', 'thumb', 'claw')
# Words in the name of a joint that turns a whole gripper.
_WHOLE = ('roll', 'rot', 'pitch', 'yaw', 'wrist', 'turn', 'spin', 'flex')
# Revolute joints behind which a branch is a hand: two arms share no more joints than this.
_HAND_BEHIND = 5


def likely_base(model: UrdfModel, names: Container[str] = ()) -> str:
    """Return the likely base link of the arm: the robot's root, with two exceptions.

    The arm is the chain with the most joints (first, with most of ``names``). If it hangs on a
    joint that is not the arm's (a rail or a lift with five or more revolute joints behind it,
    or a floating or planar joint): the link behind that joint, or, if names of links from
    there to the arm's first joint contain 'base', the shortest of these. If not, and the root
    is a world frame (`_WORLD`) with one link fixed to it: that link.

    ``names``: joints that are known to be the arm's, as in `likely_tips`; if it has any, a
    prismatic joint is part of the arm only if it is among them.
    """
    sliders = _sliders(model, names, carrying=False)
    arms = {
        link: arm
        for link in model.links
        if (arm := _arm(model, link, sliders=sliders, names=names)) is not None
    }
    # The root wins a tie.
    best = max(
        arms.values(),
        key=lambda arm: (_named(arm[1], names), len(arm[1]), arm[0] == model.root),
        default=None,
    )
    if best is not None and best[0] != model.root and best[1]:
        start, joints = best
        links, link = [start], joints[0].parent
        while link != start:
            links.append(link)
            link = model.parent_joint[link].parent
        based = [link for link in links if 'base' in link.lower()]
        return min(based, key=len) if based else start
    if model.root not in _WORLD:
        return model.root
    children = [
        link
        for link, joint in model.parent_joint.items()
        if joint.parent == model.root and joint.kind == 'fixed'
    ]
    return children[0] if len(children) == 1 else model.root


def likely_tips(model: UrdfModel, base_link: str, names: Container[str] = ()) -> list[str]:
    """Return the links behind the last joint of the arm, the likeliest tool frame first.

    The arm is the chain from the base with the most joints. Joints of a gripper's jaws and fingers
    are not counted, nor prismatic joints behind five revolute ones that carry none.

    ``names``: joints that are known to be the arm's, such as those of a table: if the robot has
    any of them, the arm is the chain with the most of them, and of prismatic joints only those
    among them count.

    Raises
    ------
    InputError
        If the base link is missing, no joint moves behind it, or there are several arms.
    """
    if base_link not in model.links:
        raise InputError(f"URDF: there is no link '{base_link}'; it has {', '.join(model.links)}")
    sliders = _sliders(model, names, carrying=True)
    arms = {
        link: arm[1]
        for link in model.links
        if (arm := _arm(model, link, base_link, sliders, names)) is not None
        and arm[0] == base_link
    }

    def worth(arm: list[UrdfJoint]) -> tuple[int, bool, int]:
        # An arm all of whose joints are named ends with them, whatever moves behind.
        count = _named(arm, names)
        return count, 0 < count == len(arm), len(arm)

    most = max(map(worth, arms.values()), default=(0, False, 0))
    if not most[2]:
        raise InputError(f"URDF: no joint moves behind link '{base_link}'; name another base link")
    ends = [link for link, arm in arms.items() if worth(arm) == most]
    parents = {joint.parent for joint in model.parent_joint.values()}

    def rank(link: str) -> tuple[int, bool, int]:
        words = link.lower()
        for i, name in enumerate(TOOL_NAMES):
            if words == name or words.endswith(f'_{name}'):
                return i, False, 0
        # Else a leaf, the last one in the file.
        return len(TOOL_NAMES), link in parents, -ends.index(link)

    ordered = sorted(ends, key=rank)
    first = {arms[link][-1].name: link for link in reversed(ordered)}
    if len(first) > 1:
        tips = ' or '.join(sorted(first.values()))
        raise InputError(
            f'URDF: there are several arms of {most[2]} joints ({", ".join(sorted(first))} are '
            f'their last ones); name the tip link, --tip-link {tips}'
        )
    return ordered


def likely_tip(model: UrdfModel, base_link: str, names: Container[str] = ()) -> str:
    """Return the likeliest tool frame, the first of `likely_tips`.

    ``names``: as in `likely_tips`.

    Raises InputError as `likely_tips` does, and if the arm goes on behind a prismatic joint that
    `names` does not have.
    """
    tip = likely_tips(model, base_link, names)[0]
    last = _arm(model, tip, base_link, _sliders(model, names, carrying=True), names)
    for joint in _moved_from(model, last[1][-1].child if last else tip):
        beyond = [j for j in _moved_from(model, joint.child) if not _is_jaw(j)]
        if joint.kind == 'prismatic' and not joint.mimic and not _is_jaw(joint) and beyond:
            raise InputError(
                f"URDF: joint '{joint.name}' of the arm slides, and the arm goes on behind it "
                f"with '{beyond[0].name}'; a table that names others has to name it, too"
            )
    return tip


def moving_before(model: UrdfModel, base_link: str) -> list[str]:
    """Return the names of the moving joints between the root and a link, from the root on.

    Moving is any but a fixed one. [] if the link is the root.
    """
    joints = []
    while (joint := model.parent_joint.get(base_link)) is not None:
        if joint.kind != 'fixed':
            joints.append(joint.name)
        base_link = joint.parent
    return joints[::-1]


def _sliders(model: UrdfModel, names: Container[str], *, carrying: bool) -> set[str]:
    """Return the names of the prismatic joints that likely belong to the arm.

    ``names``: joints known to be the arm's; if the robot has any of them, the prismatic ones
    among them are returned. Else mimic joints and joints of gripper jaws are left out, and
    those behind five revolute ones (`_HAND_BEHIND`) with no revolute one behind them.
    ``carrying``: whether a joint with five or more revolute joints behind it (a rail) is
    returned, too.
    """
    joints = model.parent_joint.values()
    named = [joint for joint in joints if joint.kind != 'fixed' and joint.name in names]
    if named:
        return {joint.name for joint in named if joint.kind == 'prismatic'}
    likely = set()
    for joint in joints:
        if joint.kind != 'prismatic' or joint.mimic or _is_jaw(joint):
            continue
        before, behind = _turning_before(model, joint.parent), _turning_behind(model, joint.child)
        is_hand = before >= _HAND_BEHIND and not behind
        if not is_hand and (carrying or behind < _HAND_BEHIND):
            likely.add(joint.name)
    return likely


def _turning_before(model: UrdfModel, link: str) -> int:
    """Return the number of the arm's revolute joints (`_turns`) between the root and a link."""
    count = 0
    while (joint := model.parent_joint.get(link)) is not None:
        count += _turns(joint)
        link = joint.parent
    return count


def _turning_behind(model: UrdfModel, link: str) -> int:
    """Return the largest number of the arm's revolute joints in one chain behind a link."""
    return max(
        (
            _turns(joint) + _turning_behind(model, joint.child)
            for joint in model.child_joints[link]
        ),
        default=0,
    )


def _turns(joint: UrdfJoint) -> bool:
    """Return whether a joint is a revolute joint of an arm, not a mimic or gripper joint."""
    return joint.kind in ('revolute', 'continuous') and not joint.mimic and not _is_jaw(joint)


def _arm(
    model: UrdfModel,
    link: str,
    base_link: str | None = None,
    sliders: Container[str] = (),
    names: Container[str] = (),
) -> tuple[str, list[UrdfJoint]] | None:
    """Return the base link of the arm that carries a link, and its moving joints, base to tip.

    From the link towards the root, up to `base_link` or a joint that is neither fixed, revolute,
    continuous nor one of the `sliders`. None if a mimic joint or a jaw (`_is_jaw`) is on the way,
    or another moving joint branches off behind the first five (a hand), unless `names` has the
    joint.
    """
    joints: list[UrdfJoint] = []
    while link != base_link and (joint := model.parent_joint.get(link)) is not None:
        moves = joint.kind in ('fixed', 'revolute', 'continuous') or joint.name in sliders
        if not moves and not joint.mimic:
            break
        if joint.mimic:
            return None
        if joint.kind != 'fixed':
            joints.append(joint)
        link = joint.parent
    joints.reverse()
    hand = any(
        joint.name not in names and len(_moved_from(model, joint.parent)) > 1
        for joint in joints[_HAND_BEHIND:]
    )
    return None if hand or any(map(_is_jaw, joints)) else (link, joints)


def _moved_from(model: UrdfModel, link: str) -> list[UrdfJoint]:
    """Return the next moving joints behind a link, behind fixed ones too; [] at a leaf."""
    joints = []
    for joint in model.child_joints[link]:
        joints += [joint] if joint.kind != 'fixed' else _moved_from(model, joint.child)
    return joints


def _is_jaw(joint: UrdfJoint) -> bool:
    """Return whether a joint moves a part of a gripper, by its name.

    True if its name or its child link's has a word for such a part (`_JAWS`), or its name has
    'grip', but no word for a joint that turns the whole gripper (`_WHOLE`).
    """
    name = joint.name.lower()
    if any(word in part for word in _JAWS for part in (name, joint.child.lower())):
        return True
    return 'grip' in name and not any(word in name for word in _WHOLE)


def _named(joints: list[UrdfJoint], names: Container[str]) -> int:
    """Number of joints whose name is in `names`."""
    return sum(joint.name in names for joint in joints)
