"""The ends of the arm in a robot description: which links are likely its base and its tool."""

from __future__ import annotations

from remaster_ros.errors import InputError
from remaster_ros.kinematics.urdf import UrdfJoint, UrdfModel

# Frames of a tool plate by the names that makers and ROS-Industrial give them, best first.
TOOL_NAMES = (
    *('tool0', 'tool', 'tcp', 'tool_link', 'tool_frame', 'tool_center_point', 'tool_tip'),
    *('link_ee', 'ee_link', 'link_eef', 'eef', 'ee', 'end_effector', 'flange', 'hand'),
)
_WORLD = ('world', 'map', 'odom')


def likely_base(model: UrdfModel) -> str:
    """Return the root, or what is fixed to it where the root is the world."""
    if model.root not in _WORLD:
        return model.root
    children = [
        link
        for link, joint in model.parent_joint.items()
        if joint.parent == model.root and joint.kind == 'fixed'
    ]
    return children[0] if len(children) == 1 else model.root


def likely_tips(model: UrdfModel, base_link: str) -> list[str]:
    """Return the links behind the last joint of the arm, the likeliest tool frame first.

    The arm is the way from the base with the most joints that turn and none that slides.

    Raises
    ------
    InputError
        No joint turns behind the base.
    """
    if base_link not in model.links:
        raise InputError(f"URDF: there is no link '{base_link}'; it has {', '.join(model.links)}")
    turning = {link: _turning(model, base_link, link) for link in model.links}
    most = max((len(joints) for joints in turning.values() if joints is not None), default=0)
    if not most:
        raise InputError(f"URDF: no joint turns behind link '{base_link}'; name another base link")
    ends = [link for link, joints in turning.items() if joints is not None and len(joints) == most]
    last = {turning[link][-1].name for link in ends}  # type: ignore[index]
    if len(last) > 1:
        raise InputError(
            f'URDF: there are several arms of {most} joints ({", ".join(sorted(last))} are their '
            'last ones); name the tip link'
        )
    parents = {joint.parent for joint in model.parent_joint.values()}

    def rank(link: str) -> tuple[int, bool, int]:
        words = link.lower()
        for i, name in enumerate(TOOL_NAMES):
            if words == name or words.endswith(f'_{name}'):
                return i, False, 0
        # Else a frame that carries nothing, the last one in the file.
        return len(TOOL_NAMES), link in parents, -ends.index(link)

    return sorted(ends, key=rank)


def _turning(model: UrdfModel, base_link: str, link: str) -> list[UrdfJoint] | None:
    """Return the joints that turn between two links; None where a way has others, or is none."""
    joints: list[UrdfJoint] = []
    while link != base_link:
        joint = model.parent_joint.get(link)
        if joint is None or joint.mimic or joint.kind not in ('fixed', 'revolute', 'continuous'):
            return None
        if joint.kind != 'fixed':
            joints.append(joint)
        link = joint.parent
    return joints[::-1]
