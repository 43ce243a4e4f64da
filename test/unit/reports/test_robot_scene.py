# SPDX-License-Identifier: Apache-2.0
"""The scene that pages draw: the arm's own meshes where they can be read, else its bodies."""

import numpy as np
import pytest
import trimesh
from worlds.robot_descriptions import irb120
from worlds.simple_cells import write_cell

from remaster_ros.kinematics.transforms import apply
from remaster_ros.reports.robot_scene import MOST_TRIANGLES, coarser, robot_scene
from remaster_ros.session.cells.workcell import read_cell

MARKERS = {'smr': [0.0, 0.0, 0.1]}
SENSORS = {'tracker': {'marker': 'smr', 'topic': 'at', 'rough_position_m': [2.0, 0.5, 1.0]}}
TABLE = {'table': {'center_m': [0.6, 0.0, 0.2], 'size_m': [0.4, 0.8, 0.4], 'yaw_deg': 90.0}}
LINKS = ['base_link', *(f'link_{i}' for i in range(1, 7))]
# Follows joint 2, but hangs on link 1.
COVER = 'cover'


def scene_with(folder, meshes):
    """Return the scene of an IRB 120 in a cell, with these of its meshes there, mm."""
    (folder / 'abb' / 'meshes').mkdir(parents=True)
    for name, mesh in meshes.items():
        mesh.export(folder / 'abb' / 'meshes' / f'{name}.stl')
    urdf = irb120().urdf.replace('a_robot/meshes/visual/cover.dae', 'abb/meshes/cover.stl')
    (folder / 'robot.urdf').write_text(urdf)
    cell = read_cell(
        write_cell(
            folder / 'cell.yaml',
            robot={'urdf': 'robot.urdf', 'base_link': 'base_link', 'tip_link': 'tool0'},
            markers=MARKERS,
            sensors=SENSORS,
            aim_at='tracker',
            held_joint='',
            held_values_deg=[],
            tool={},
            obstacles=TABLE,
        )
    )
    return robot_scene(cell, cell.planning_scene(cell.chain()))


def brick():
    return trimesh.creation.box((20.0, 40.0, 60.0))


def test_meshes_are_where_the_links_are(tmp_path):
    scene = scene_with(tmp_path, {name: brick() for name in [*LINKS, COVER]})
    assert scene.notes == []
    links = {surface.name: surface for surface in scene.surfaces if surface.role == 'link'}
    assert list(links) == [*LINKS, COVER]
    assert links[COVER].link == 1
    q = np.array([0.3, -0.2, 0.5, 1.0, -0.7, 0.4])
    frames = scene.transforms(np.array([q, 0 * q]))
    assert frames.shape == (2, 7, 4, 4)
    for number, name in enumerate(LINKS):
        assert (links[name].link, links[name].color) == (number, (0.7, 0.7, 0.7))
        place = np.eye(4) if number == 0 else scene.chain.frames(q)[number - 1]
        np.testing.assert_allclose(frames[0, number], place)
        # Its <origin> is 0.1 m up, its x to the left of the link, y up, z to the front.
        drawn = links[name].vertices
        np.testing.assert_allclose(drawn.mean(axis=0), [0, 0, 0.1], atol=1e-9)
        np.testing.assert_allclose(np.ptp(drawn, axis=0), [0.06, 0.02, 0.04], atol=1e-9)


def test_a_link_without_its_mesh_is_drawn_as_the_collision_checks_have_it(tmp_path):
    scene = scene_with(tmp_path, {name: brick() for name in [*LINKS[:3], *LINKS[4:], COVER]})
    (note,) = scene.notes
    assert note.startswith('package://abb/meshes/link_3.stl cannot be read')
    assert 'mesh_path' in note
    third = [surface for surface in scene.surfaces if surface.link == 3]
    # Its collision geometry is a cylinder of 0.2 m.
    (drawn,) = third
    assert drawn.vertices[:, 2].max() == pytest.approx(0.1)
    assert np.hypot(*drawn.vertices[:, :2].T).max() == pytest.approx(0.06, rel=0.01)


def test_obstacles_tool_markers_and_sensors_are_in_the_scene(tmp_path):
    scene = scene_with(tmp_path, {})
    roles = {surface.name: surface for surface in scene.surfaces}
    table = roles['obstacle table']
    assert (table.role, table.link) == ('obstacle', 0)
    np.testing.assert_allclose(table.vertices.max(axis=0), [1.0, 0.2, 0.4], atol=1e-9)
    assert roles['marker smr'].role == 'marker'
    (sight,) = scene.sights
    np.testing.assert_array_equal(sight.sensor_R, [2.0, 0.5, 1.0])
    q = np.array([0.3, -0.2, 0.5, 1.0, -0.7, 0.4])
    there = scene.chain.positions(q, MARKERS['smr'])
    np.testing.assert_array_equal(sight.marker_T, MARKERS['smr'])
    # The marker that is drawn is where the line of sight ends.
    marker = apply(scene.transforms(q)[6], roles['marker smr'].vertices)
    np.testing.assert_allclose((marker.min(axis=0) + marker.max(axis=0)) / 2, there, atol=1e-3)
    assert scene.floor_z == 0.0


def test_large_meshes_keep_their_shape_with_few_triangles():
    fine = trimesh.creation.icosphere(subdivisions=6, radius=0.1)
    assert len(fine.faces) > 20 * MOST_TRIANGLES
    points, faces = coarser(fine.vertices, fine.faces.astype(np.int64))
    assert 0.3 * MOST_TRIANGLES < len(faces) <= MOST_TRIANGLES
    # Still closed, and facing outwards.
    again = trimesh.Trimesh(points, faces, process=False)
    assert again.is_watertight
    assert again.volume == pytest.approx(fine.volume, rel=0.02)
    assert np.abs(np.linalg.norm(points, axis=1) - 0.1).max() < 0.002


def test_equal_corners_of_small_meshes_are_merged_and_nothing_else():
    mesh = brick()
    soup = mesh.triangles.reshape(-1, 3)
    points, faces = coarser(soup, np.arange(len(soup)).reshape(-1, 3))
    assert (len(points), len(faces)) == (8, 12)
    assert trimesh.Trimesh(points, faces).volume == pytest.approx(mesh.volume)
