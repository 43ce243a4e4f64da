# SPDX-License-Identifier: Apache-2.0
"""What discovery.json holds, for tests of what reads it."""

from __future__ import annotations

from typing import Any


def effect(name: str = 'joint_compliance', joints: tuple[int, ...] = (2,), **more: Any) -> dict:
    """Return a cause as the file has it; ``more`` are further fields and others' values."""
    return {
        'name': name,
        'joints': list(joints),
        'place': 'joint_angle',
        'driver': 'gravity_torque',
        'form': 'linear',
        'parameters': [{'name': 'size_2', 'value': 1e-3, 'std': 1e-5, 'unit': 'm'}],
        'p_value': 0.003,
        'log_evidence_gain': 40.0,
        'confusable_with': [],
        'cause': 'The cause.',
        **more,
    }


def look_alike(name: str, joints: tuple[int, ...] = (), **more: Any) -> dict:
    """Return what a cause may be confused with."""
    plain = {'log_evidence_gain': 39.0, 'separate_by': 'poses'}
    return {'name': name, 'joints': list(joints), **plain, **more}


def discovery_content(*effects: dict, **more: Any) -> dict:
    """Return the file with these causes; ``more`` are further keys and others' values."""
    return {
        'format': 'remaster-discovery/1',
        'verdict': 'undetermined',
        'effects': list(effects),
        'gain': {
            'held_out_rms_before_m': 1e-3,
            'held_out_rms_after_m': 1e-3,
            'noise_floor_m': 1e-4,
        },
        'noise': {'pose_common_fraction': 0.5, 'outliers': [], 'heteroscedastic': {}},
        'joint_offsets_after': [],
        **more,
    }
