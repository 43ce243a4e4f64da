"""Files of one maker's own form, read into named columns: one file a maker, one function each."""

from __future__ import annotations

from collections.abc import Callable

from remaster_ros.importing.makers import (
    axis_lines,
    doosan,
    fanuc,
    gsi,
    inform,
    kawasaki,
    keyed,
    kuka,
    listed,
    motive,
    rapid,
    ros_echo,
    staubli,
    ur_script,
    vicon,
)
from remaster_ros.importing.makers.named import Named

# Each returns None where a text is not of its kind.
READERS: tuple[Callable[[str], Named | None], ...] = (
    motive.read,
    vicon.read,
    fanuc.read,
    kuka.read,
    inform.read,
    kawasaki.read,
    # Before URScript, whose moves are called so too.
    doosan.read,
    ur_script.read,
    # Before RAPID, whose logs have two lists in brackets.
    listed.read,
    rapid.read,
    staubli.read,
    gsi.read,
    ros_echo.read,
    keyed.read,
    axis_lines.read,
)
