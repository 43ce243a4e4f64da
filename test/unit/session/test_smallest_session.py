# SPDX-License-Identifier: Apache-2.0
"""The smallest session of docs/session-format.md is one, and can be fitted."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.discovery.effects import registration_drift, thermal_growth
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.errors import InputError
from remaster_ros.reports.fit_json import fit_content
from remaster_ros.reports.result_folder import save_fit
from remaster_ros.reports.result_lines import fit_lines
from remaster_ros.session.records.reader import read_session, write_session

PAGE = Path(__file__).parents[3] / 'docs/session-format.md'


@pytest.fixture
def folder(tmp_path):
    """Return a folder with the files of the page."""
    files = re.findall(r'^`([a-z.]+)`:\n\n```[a-z]+\n(.*?)^```$', PAGE.read_text(), re.M | re.S)
    assert [name for name, _ in files] == ['session.yaml', 'observations.csv', 'robot.urdf']
    for name, text in files:
        (tmp_path / name).write_text(text)
    return tmp_path


def test_it_is_read_without_a_warning(folder, caplog):
    session = read_session(folder)
    assert len(session.measurements) == 8
    assert not session.timed
    assert session.settle_s is None
    assert np.all(np.isnan(session.measurements.from_q))
    assert not caplog.records


def test_it_can_be_fitted_and_its_page_tells_that_times_are_unknown(folder, tmp_path):
    result = fit_session(read_session(folder), rng=np.random.default_rng(0))
    assert result.identifiable.tolist() == [False, True, False]
    # The numbers of the page were made with this offset, and 0.05 mm of noise.
    assert abs(result.joint_offsets[1] - 0.004) < 4.0 * result.joint_offsets_std[1]
    assert 'without times' in '\n'.join(fit_lines(fit_content(result)))
    save_fit(result, tmp_path / 'fit')
    assert 'without times' in (tmp_path / 'fit/report.html').read_text()


def test_causes_that_time_drives_are_untestable_without_times(folder):
    session = read_session(folder)
    for timed, why in ((True, ''), (False, 'times: none')):
        problem = Problem.of(replace(session, timed=timed))
        context = Residuals.of(estimate(problem)).context
        for effect in (registration_drift.EFFECT, thermal_growth.EFFECT):
            assert why in effect.needs(context)
            assert bool(effect.needs(context)) is not timed
            assert effect.needs(context.at(np.arange(3))) == effect.needs(context)


def test_what_it_has_not_is_written_as_unknown(folder, tmp_path):
    session = replace(read_session(folder), operator='A. B.', serial_number='0042')
    write_session(tmp_path / 'copy', session)
    text = (tmp_path / 'copy/session.yaml').read_text()
    assert 'times: none' in text
    assert 'settle_s' not in text
    again = read_session(tmp_path / 'copy')
    assert (again.timed, again.settle_s) == (False, None)
    assert (again.operator, again.serial_number) == ('A. B.', '0042')


def test_a_needed_column_is_missed_and_the_remedy_named(folder):
    path = folder / 'observations.csv'
    path.write_text(path.read_text().replace('stamp_s', 'time', 1))
    with pytest.raises(InputError, match=r'line 1: column stamp_s is missing; .*remaster import'):
        read_session(folder)
