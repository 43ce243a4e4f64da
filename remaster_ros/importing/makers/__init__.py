# SPDX-License-Identifier: Apache-2.0
"""Readers of makers' own file formats into named columns: one file a maker."""

from __future__ import annotations

from collections.abc import Callable

from remaster_ros.importing.makers import (
    axis_lines,
    doosan,
    fanuc,
    gsi,
    inform,
    json_text,
    kawasaki,
    keyed,
    kuka,
    listed,
    motive,
    numpy_file,
    pacscript,
    qualisys,
    rapid,
    replies,
    ros_echo,
    staubli,
    ur_script,
    vicon,
    workbook,
    yaml_text,
)
from remaster_ros.importing.makers.named import NamedColumns

# Each reader returns None for a text of another format.
READERS: tuple[Callable[[str], NamedColumns | None], ...] = (
    json_text.read,
    motive.read,
    vicon.read,
    qualisys.read,
    fanuc.read,
    kuka.read,
    inform.read,
    kawasaki.read,
    # Before URScript, whose moves are called so too.
    doosan.read,
    ur_script.read,
    pacscript.read,
    # Before lists without the state of a reply.
    replies.read,
    # Before RAPID, whose logs have two lists in brackets.
    listed.read,
    rapid.read,
    staubli.read,
    gsi.read,
    ros_echo.read,
    keyed.read,
    axis_lines.read,
    yaml_text.read,
)

# Readers of binary files: tables as text by their names; None for a file of another format.
UNPACKERS: tuple[Callable[[bytes], dict[str, str] | None], ...] = (workbook.read, numpy_file.read)
