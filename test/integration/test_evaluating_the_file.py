# SPDX-License-Identifier: Apache-2.0
"""compensation.json by itself: an evaluator with nothing but NumPy, the file and its URDF.

It ships as docs/examples/evaluate_compensation.py, is written from docs/files.md and shares no
code with the package: what the page does not state, it could not compute.
"""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds.compensation_files import arm, save
from worlds.hidden_tours import robot
from worlds.sliding_cells import rail

from remaster_ros.compensation.arm_model import BaseTerm, Function, Geometry, JointTerm
from remaster_ros.compensation.compensator import Compensator
from remaster_ros.compensation.file import read_compensation
from remaster_ros.kinematics.transforms import rotation_vector_to_matrix, transform

DOCS = Path(__file__).parents[2] / 'docs'
EVALUATOR = DOCS / 'examples/evaluate_compensation.py'


def evaluator():
    spec = importlib.util.spec_from_file_location('evaluate_compensation', EVALUATOR)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def everything(urdf: str, seed: int):
    """Return an arm that errs in every way that the file has a place for."""
    rng = np.random.default_rng(seed)
    plain = arm(urdf)
    k = plain.joints
    ends = np.linspace(-2.0, 2.0, 8)
    knots = np.concatenate((np.full(3, ends[0]), ends, np.full(3, ends[-1])))
    turning = 2.0 * np.pi * np.arange(-3, 12) / 8.0
    functions = [
        *(Function('angle', 'sin', j, 1) for j in range(k)),
        *(Function('angle', 'cos', j, 2) for j in range(k)),
        Function('angle', 'linear', 1),
        Function('angle', 'quadratic', 2),
        Function('angle', 'bspline', 1, knots=knots, degree=3),
        Function('angle', 'bspline', 3, knots=turning, degree=3, turn_start=0.0),
        *(Function('gravity_torque', 'linear', j) for j in range(k)),
        Function('gravity_torque', 'quadratic', 1),
        Function('temperature', 'linear'),
        Function('none', 'constant'),
    ]
    units = {'gravity_torque': 3e-5, 'temperature': 1e-4}
    sizes = [
        units.get(f.driver, 5e-4) / (40.0 if f.form == 'quadratic' else 1.0) for f in functions
    ]
    of = [f.joint if f.joint >= 0 else 2 for f in functions]
    # One couples: the angle of another joint drives it.
    of[0] = k - 1
    terms = sorted(
        (
            JointTerm(j, 'x', f, size * rng.standard_normal(f.size))
            for j, f, size in zip(of, functions, sizes, strict=True)
        ),
        key=lambda term: term.joint,
    )
    base = (
        BaseTerm(
            'base_compliance', Function('gravity_moment', 'linear'), 2e-6 * rng.normal(size=3)
        ),
        BaseTerm('base_compliance', Function('angle', 'cos', 0, 1), 1e-4 * rng.normal(size=3)),
    )

    def origins(shift: float, turn: float) -> Geometry:
        return Geometry(shift * rng.normal(size=(k + 1, 3)), turn * rng.normal(size=(k + 1, 3)))

    return replace(
        plain,
        joint_offsets=np.radians(0.3) * rng.standard_normal(k) * plain.chain.per_radian,
        joint_terms=tuple(terms),
        base_terms=base,
        geometry=origins(3e-4, 5e-4),
        growth=origins(1e-5, 1e-5),
        lateral_compliance=np.abs(3e-6 * rng.standard_normal(k)),
        reference_c=20.0,
        mean_c=26.0,
        T_R_N={'mocap': transform(rotation_vector_to_matrix(rng.normal(size=3)), (2.0, 0.3, 1.1))},
    )


@pytest.mark.parametrize('name', ['lwr4plus', 'six', 'rail'])
def test_the_file_says_where_the_arm_is(tmp_path, name):
    urdf = rail() if name == 'rail' else robot(name)
    model = everything(urdf, 3)
    path = save(tmp_path, model, urdf)
    found = evaluator().Arm(json.loads(path.read_text(encoding='utf-8')))
    file = read_compensation(path)
    low, high = model.chain.usual_range
    q = np.random.default_rng(5).uniform(low, high, (25, model.joints))
    for warm in (None, 31.0):
        tools = file.compensator.tool(q, warm)
        np.testing.assert_allclose([found.tool(row, warm) for row in q], tools, atol=1e-12)
        state = file.model.state(q, warm)
        seen = [found.seen(row, 'mocap', 'sir', warm) for row in q]
        np.testing.assert_allclose(seen, file.model.in_sensor(state, 'mocap', 'sir'), atol=1e-12)
    np.testing.assert_allclose(
        [found.nominal(row) for row in q], model.chain.forward(q), atol=1e-12
    )
    # Each part moves the tool: none is tested by being nothing.
    there = found.tool(q[0])
    for key in ('joints', 'geometry', 'base_terms', 'masses', 'temperature'):
        less = json.loads(path.read_text(encoding='utf-8'))
        if key == 'joints':
            for joint in less[key]:
                joint['terms'] = []
        elif key == 'masses':
            for part in less[key]:
                part.pop('lateral_compliance', None)
        elif key == 'base_terms':
            less[key] = []
        else:
            less[key]['origins'] = []
        assert np.abs(evaluator().Arm(less).tool(q[0]) - there)[:3, 3].max() > 1e-6, key


def test_what_it_commands_is_what_the_package_commands(tmp_path):
    model = everything(robot('six'), 4)
    module, path = evaluator(), save(tmp_path, model, robot('six'))
    found = module.Arm(json.loads(path.read_text(encoding='utf-8')))
    compensator = Compensator(read_compensation(path).model)
    q = np.random.default_rng(6).uniform(-1.2, 1.2, (12, 6))
    done = compensator.correct(q)
    regular = np.flatnonzero(~done.incomplete)
    assert len(regular) > 5
    commands = [module.command(found, q[row]) for row in regular]
    np.testing.assert_allclose(commands, done.command[regular], atol=1e-5)


def test_it_runs_by_itself(tmp_path):
    path = save(tmp_path, everything(robot('six'), 4), robot('six'))
    angles = ['0.1', '-0.5', '0.6', '0.2', '0.9', '0.3']
    # Without this package, and without the site's other ones but NumPy.
    done = subprocess.run(
        [sys.executable, str(EVALUATOR), str(path), *angles],
        capture_output=True, text=True, check=True, cwd=tmp_path,
    )  # fmt: skip
    assert done.stdout.count('[') == 2
    imports = re.findall(r'^(?:from|import) ([\w.]+)', EVALUATOR.read_text(), re.MULTILINE)
    assert {name.split('.')[0] for name in imports} - {*sys.stdlib_module_names} == {'numpy'}


def test_every_key_that_a_file_can_have_is_on_the_page(tmp_path):
    """Keys, drivers and forms, by their names."""
    urdf = robot('six')
    page = (DOCS / 'files.md').read_text(encoding='utf-8')
    page = page[page.index('## apply/compensation.json') : page.index('## truth.json')]
    content = json.loads(save(tmp_path, everything(urdf, 4), urdf).read_text(encoding='utf-8'))

    def keys(part, of=''):
        if isinstance(part, dict):
            for key, value in part.items():
                if of not in ('base_frame', 'tool'):
                    yield key
                yield from keys(value, '' if of in ('base_frame', 'tool') else key)
        elif isinstance(part, list):
            for value in part:
                yield from keys(value, of)

    named = set(keys(content)) | {'gravity_moment', 'lateral_compliance', 'knots_m', 'offset_m'}
    missing = sorted(name for name in named if f'`{name}`' not in page)
    assert not missing, missing
