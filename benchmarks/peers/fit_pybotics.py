# SPDX-License-Identifier: Apache-2.0
"""Fit a session with pybotics, as its own calibration example does; see bench_peers.py.

Offsets of all joints, the sensor's frame and the marker, by `scipy.optimize.least_squares` on
pybotics' `optimize_accuracy`. Prints JSON.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
from pybotics.geometry import matrix_2_vector, vector_2_matrix
from pybotics.kinematic_chain import MDHKinematicChain
from pybotics.optimization import OptimizationHandler, compute_absolute_errors, optimize_accuracy
from pybotics.robot import Robot
from pybotics.tool import Tool
from scipy.optimize import least_squares

folder = Path(sys.argv[1])
data = {split: np.load(folder / f'{split}.npz') for split in ('fit', 'validation')}
given = json.loads((folder / 'given.json').read_text(encoding='utf-8'))

tool = Tool(matrix=vector_2_matrix([*given['marker_m'], 0.0, 0.0, 0.0]))
robot = Robot(
    MDHKinematicChain.from_parameters(np.array(given['modified_dh'])),
    tool=tool,
    world_frame=vector_2_matrix(matrix_2_vector(np.array(given['T_N_R']))),
)
nominal = robot.fk(data['fit']['q'][0])[:3, 3]
assert np.allclose(nominal, data['fit']['nominal'][0], atol=1e-6), 'another robot'

# alpha, a, theta, d of each link: theta alone is free.
handler = OptimizationHandler(
    robot,
    kinematic_chain_mask=[False, False, True, False] * len(given['modified_dh']),
    tool_mask=[True, True, True, False, False, False],
    world_mask=True,
)
started = time.process_time()
result = least_squares(
    optimize_accuracy,
    handler.generate_optimization_vector(),
    args=(handler, data['fit']['q'], data['fit']['position']),
    method='lm',
    x_scale='jac',
)
handler.apply_optimization_vector(result.x)
seconds = time.process_time() - started
errors = compute_absolute_errors(
    data['validation']['q'], data['validation']['position'], handler.robot
)
thetas = handler.robot.kinematic_chain.vector[2::4] - np.array(given['modified_dh'])[:, 2]
print(
    json.dumps(
        {
            'seconds': seconds,
            'held_out_m': float(np.mean(errors)),
            'offsets': thetas.tolist(),
            'std': None,
            'uncertainty': 'none',
        }
    )
)
