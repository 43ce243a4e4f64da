# SPDX-License-Identifier: Apache-2.0
"""Mesh files: found by their name in a URDF, and read into arrays.

Collision geometry has vertices only, visual geometry triangles and colours.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.session.cells.packages import Confinement, find_package, package_of, sourced
from remaster_ros.session.files import read_limited, refuse_utf16
from remaster_ros.types import FloatArray, IntArray

MESH_LIMIT = 64 * 1024**2
_ENCODING = re.compile(rb'<\?xml[^>]*?encoding\s*=\s*["\']([^"\']*)["\']')
_ASCII_LIKE = (b'utf-8', b'us-ascii', b'ascii', b'iso-8859-1', b'iso-8859-15', b'windows-1252')
KINDS = ('.stl', '.obj', '.dae', '.ply')

Taken = TypeVar('Taken')


def mesh_reader(urdf: Path, mesh_path: Sequence[Path] = ()) -> Callable[[str], FloatArray]:
    """Return a function that reads the meshes named in a URDF file.

    ``package://NAME/rest`` is searched as ``NAME/rest`` in the folders of `mesh_path`, in the
    share folders of AMENT_PREFIX_PATH, and beside and above the URDF (a package's URDF lies inside
    the package), also if the package's folder has another name. ``file://`` and plain names are
    relative to the URDF's folder, then to those of `mesh_path`. Files in none of these folders and
    in no ROS package are not read.

    Parameters
    ----------
    urdf
        The URDF file.
    mesh_path
        Folders to search.

    Returns
    -------
    callable
        File name as written -> vertices, m, (n, 3). It raises InputError if the file is missing or
        unreadable, since a link without its mesh would be a link that collides with nothing.
    """
    return cache(lambda name: read_mesh(find_mesh(name, urdf, mesh_path)))


def find_mesh(name: str, urdf: Path, mesh_path: Sequence[Path]) -> Path:
    """Return the path of a mesh file by its name in a URDF; arguments as of `mesh_reader`.

    Raises InputError if there is no such file, or only outside of the folders that may be
    read.
    """
    folders: list[Path] = [*mesh_path]
    files = Confinement(urdf, mesh_path)
    candidates: list[Path] = []
    if name.startswith('package://'):
        inside = unquote(name.removeprefix('package://'))
        package, _, relative_path = inside.partition('/')
        folder = find_package(package, urdf, mesh_path)
        if folder is not None:
            files.add(folder)
            candidates.append(folder / relative_path)
        folders += [*sourced(), *urdf.resolve().parents]
    elif '://' in name and not name.startswith('file://'):
        raise InputError(f'{urdf}: the mesh {name} cannot be fetched; name a package:// or a file')
    else:
        inside = unquote(name.removeprefix('file://'))
        folders.insert(0, urdf.parent)
    candidates += [folder / inside for folder in folders]
    there = [path for path in candidates if path.is_file()]
    for path in there:
        # A description that xacro has expanded names files of other packages by their whole paths.
        if files.holds(path) or package_of(path.resolve()) is not None:
            return path
    if there:
        raise InputError(
            f'{urdf}: the mesh {name} ({there[0]}) lies outside of the folder of the description '
            'and of any ROS package; give its folder as mesh_path of the cell file'
        )
    raise InputError(
        f'{urdf}: there is no mesh {name} (looked for {", ".join(map(str, candidates[:6]))}); '
        'give the folder that holds it, or its package, as mesh_path of the cell file, or source '
        'the workspace of its package'
    )


def read_mesh(path: Path) -> FloatArray:
    """Return the vertices of a mesh file (STL, OBJ, DAE or PLY), m, (n, 3).

    Lengths are in m, in DAE in the file's own unit. Raises InputError if the file is missing, over
    64 MiB or damaged, or has fewer than 4 vertices or one that is not finite.
    """
    vertices = _loaded(path, _vertices, skip_materials=True)
    if len(vertices) < 4 or not np.all(np.isfinite(vertices)):
        raise InputError(f'{path}: the mesh has {len(vertices)} vertices, or some not finite')
    return vertices


@dataclass(frozen=True, eq=False)
class MeshPart:
    """A part of a mesh in one colour, for pictures."""

    vertices: FloatArray  # m, (n, 3)
    faces: IntArray  # Which three vertices each triangle has, (m, 3)
    # Red, green and blue, 0 to 1; None where the file gives none
    color: tuple[float, float, float] | None


def read_mesh_parts(path: Path) -> list[MeshPart]:
    """Return the surfaces of a mesh file, one part for each colour and one for those without.

    Parts with a vertex that is not finite are left out. Raises InputError if the file cannot
    be read, or no triangle is left.
    """
    parts = _loaded(path, _parts, skip_materials=False)
    if not parts:
        raise InputError(f'{path}: the mesh has no triangles, or vertices that are not finite')
    return parts


def _vertices(loaded: list[Any], unit: float) -> FloatArray:
    """Return the vertices of trimesh parts, times ``unit``, m, (n, 3)."""
    points = [point for part in loaded for point in getattr(part, 'vertices', ())]
    vertices: FloatArray = np.array(points, dtype=float).reshape(-1, 3) * unit
    return vertices


def _parts(loaded: list[Any], unit: float) -> list[MeshPart]:
    """Return the surfaces of trimesh parts by colour; ``unit``: length of their unit, m.

    Parts without triangles, or with vertices that are not finite, are left out.
    """
    by_color: dict[tuple[float, float, float] | None, list[Any]] = {}
    for part in loaded:
        if len(getattr(part, 'faces', ())) and np.all(np.isfinite(part.vertices)):
            by_color.setdefault(_color(part), []).append(part)
    parts = []
    for color, same in by_color.items():
        starts = np.cumsum([0, *(len(part.vertices) for part in same)])
        vertices = np.concatenate([part.vertices for part in same]) * unit
        faces = np.concatenate([part.faces + first for part, first in zip(same, starts)])
        parts.append(MeshPart(vertices, faces.astype(np.int64), color))
    return parts


def _color(part: Any) -> tuple[float, float, float] | None:
    """Return the colour of a trimesh part, red, green, blue from 0 to 1; None without one."""
    visual = part.visual
    main = getattr(getattr(visual, 'material', None), 'main_color', None)
    if main is None and visual.defined:
        main = getattr(visual, 'main_color', None)
    if main is None:
        return None
    red, green, blue = (np.asarray(main, dtype=float)[:3] / 255.0).tolist()
    return red, green, blue


def _loaded(
    path: Path, take: Callable[[list[Any], float], Taken], *, skip_materials: bool
) -> Taken:
    """Return the result of ``take``, called with the parts of a mesh file and its unit, m.

    ``take``: function of a list of trimesh objects and the length of their unit;
    ``skip_materials``: do not read textures. Raises InputError if the format is not in
    `KINDS`, the file is missing, over 64 MiB or damaged, or ``take`` fails.
    """
    kind = path.suffix.lower()
    if kind not in KINDS:
        raise InputError(f'{path}: a mesh in a format that is not read; use {", ".join(KINDS)}')
    content = read_limited(path, MESH_LIMIT, 'the URDF names it as a mesh')
    if kind == '.dae':
        _refuse_entities(content, path)
    # Not at import: it takes a second, and most commands read no mesh.
    import trimesh

    try:
        scene = trimesh.load_scene(
            BytesIO(content), file_type=kind[1:], skip_materials=skip_materials
        )
        # Instances in their places; COLLADA files state the length of their unit.
        return take(list(scene.dump()), _collada_unit(content) if kind == '.dae' else 1.0)
    except Exception as error:
        # Whatever a parser of foreign bytes raises, one line comes out.
        raise InputError(f'{path}: no {kind[1:].upper()} mesh ({_line(error)})') from None


def _refuse_entities(content: bytes, path: Path) -> None:
    """Raise InputError if a COLLADA file is not plain XML or declares entities."""
    refuse_utf16(content, path)
    text = content.removeprefix(b'\xef\xbb\xbf').lstrip()
    encoding = _ENCODING.match(text)
    plain = encoding is None or encoding[1].lower() in _ASCII_LIKE
    # An archive of them begins otherwise.
    if not text.startswith(b'<') or not plain or b'<!DOCTYPE' in text or b'<!ENTITY' in text:
        raise InputError(
            f'{path}: no plain COLLADA file (an archive, another encoding, or one that declares a '
            'DOCTYPE or entities); export it anew'
        )


def _collada_unit(content: bytes) -> float:
    """Return the length of a COLLADA file's unit, m; 1 if it states none."""
    import collada

    return float(collada.Collada(BytesIO(content)).assetInfo.unitmeter or 1.0)


def _line(error: Exception) -> str:
    """Return type and text of an error as one line of at most 200 characters."""
    return ' '.join(f'{type(error).__name__}: {error}'.split())[:200]
