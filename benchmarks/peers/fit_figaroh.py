# SPDX-License-Identifier: Apache-2.0
"""Fit a session with figaroh: its joint-offset calibration; see bench_peers.py.

Sensor frame and marker are unknown frames of its model, the rest are its defaults; the cost
function is the one its documentation asks for. Prints JSON as its last line.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
import yaml
from figaroh.calibration.base_calibration import BaseCalibration
from figaroh.calibration.calibration_tools import calc_updated_fkm
from figaroh.tools.load_robot import load_robot

folder = Path(sys.argv[1])
given = json.loads((folder / 'given.json').read_text(encoding='utf-8'))
config = {
    'robot': {'name': given['robot']},
    'tasks': {
        'calibration': {
            'type': 'kinematic_calibration',
            'kinematics': {'base_frame': 'universe', 'tool_frame': given['tip_link']},
            'joints': {'active_joints': given['joints']},
            'parameters': {'calibration_level': 'joint_offset', 'outlier_threshold': 0.05},
            'measurements': {
                'markers': [{'measurable_dof': [True, True, True, False, False, False]}]
            },
            'data': {
                'source_file': str(folder / 'fit.csv'),
                'validation_data_file': str(folder / 'validation.csv'),
            },
        }
    },
}
(folder / 'figaroh.yaml').write_text(yaml.safe_dump(config), encoding='utf-8')


class Calibration(BaseCalibration):
    """Residuals in the sensor's frame, not weighted."""

    def cost_function(self, var):
        """Return residuals, m."""
        predicted = calc_updated_fkm(
            self.model, self.data, var, self.q_measured, self.calib_config
        )
        return self._compute_logmap_residuals(self.PEE_measured, predicted, position_frame='world')


robot = load_robot(str(folder / 'robot.urdf'), load_by_urdf=True)
calibration = Calibration(robot, str(folder / 'figaroh.yaml'))
started = time.process_time()
# What the configuration format has no key for: both frames are unknown.
calibration.calib_config.update(known_baseframe=False, known_tipframe=False)
calibration.initialize()
calibration.solve(enable_logging=False)
seconds = time.process_time() - started

var = calibration.LM_result.x
names = calibration.calib_config['param_name']
held_out = {**calibration.calib_config, 'NbSample': len(calibration._q_val)}
predicted = calc_updated_fkm(
    calibration.model, calibration.data, var, calibration._q_val, held_out
)
error = (np.asarray(calibration._PEE_val) - np.asarray(predicted)).reshape(3, -1)
found, std = dict(zip(names, var)), dict(zip(names, calibration.std_dev))
of_joint = {joint: [n for n in names if joint in n] for joint in given['joints']}
print(
    json.dumps(
        {
            'seconds': seconds,
            'held_out_m': float(np.mean(np.linalg.norm(error, axis=0))),
            'offsets': [
                sign * float(found[n[0]]) if n else 0.0
                for sign, n in zip(given['signs'], of_joint.values())
            ],
            'std': [float(std[n[0]]) if n else None for n in of_joint.values()],
            'uncertainty': 'std of least squares',
            'names': list(names),
        }
    )
)
