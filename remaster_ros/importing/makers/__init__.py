"""Files of one maker's own form, read into named columns: one file a maker, one function each."""

from __future__ import annotations

from collections.abc import Callable

from remaster_ros.importing.makers import (
    fanuc,
    kuka,
    motive,
    rapid,
    ros_echo,
    staubli,
    ur_script,
)
from remaster_ros.importing.makers.named import Named

# Each returns None where a text is not of its kind.
READERS: tuple[Callable[[str], Named | None], ...] = (
    motive.read,
    fanuc.read,
    kuka.read,
    rapid.read,
    staubli.read,
    ur_script.read,
    ros_echo.read,
)
