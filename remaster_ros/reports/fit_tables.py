"""Rows of the tables that the pages of a fit share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from remaster_ros.calibration.orientation_accuracy import METRICS as ORIENTATION
from remaster_ros.reports.schemas import Accuracy
from remaster_ros.types import Session


def accuracy_rows(accuracy: Accuracy) -> list[dict[str, Any]]:
    """Return one row per split and metric, and the reason where there is no number."""
    titles = {
        'post_registration': 'Position, sensor registered (eq.\u00a018)',
        'post_registration_orientation': '… orientation',
        'relative': 'Distances between solutions of a pose (eq.\u00a017)',
        'relative_orientation': '… angles',
        'theoretical': 'What the posterior predicts (section V-C)',
        'paper_theoretical': '… in the robot base, offsets alone, as the paper has it',
        'theoretical_random': 'The same predicted at 1,000 random configurations',
        'paper_theoretical_random': '… in the robot base, as the paper has it',
    }
    rows = []
    for split in ('validation', 'optimization'):
        metrics = getattr(accuracy, split)
        if metrics is None:
            continue
        for metric, title in titles.items():
            at_random = metric.endswith('_random')
            if at_random and split == 'validation':
                continue  # They are the same for both.
            if metric in ORIENTATION and metric not in metrics:
                continue
            sides = metrics[metric]
            rows.append(
                {
                    'split': 'any' if at_random else split,
                    'title': title,
                    'angular': metric in ORIENTATION,
                    'cells': [sides.get(side) for side in ('before', 'after')],
                    'offsets_only': sides.get('after_offsets_only'),
                    'why': sides.get('why', ''),
                }
            )
    return rows


def marker_rows(fit: Mapping[str, Any], session: Session) -> list[dict[str, Any]]:
    """Return one row per marker of a fit.json: place, std, and how far from the nominal place."""
    rows = []
    for name, marker in fit['markers'].items():
        position = np.array(marker['position_m'])
        rows.append(
            {
                'name': name,
                'position_mm': (1e3 * position).tolist(),
                'std_mm': (1e3 * np.array(marker['std_m'])).tolist(),
                'moved_mm': 1e3 * float(np.linalg.norm(position - session.markers[name])),
            }
        )
    return rows
