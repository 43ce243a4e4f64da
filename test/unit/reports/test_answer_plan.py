# SPDX-License-Identifier: Apache-2.0
"""What the page of `remaster report` tells of the plan of its session."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from remaster_ros.collection.plan_confirmation import fingerprint
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.candidates import Plan, PlannedPose
from remaster_ros.planning.tour_order import FITTED, REFERENCE, Tour
from remaster_ros.reports.answer import answer_of
from remaster_ros.reports.answer_figures import Subject, draw_answer, planned
from remaster_ros.reports.fit_json import fit_content
from remaster_ros.reports.plan_facts import copy_plan, drawn_plan, plan_facts, plan_to_dict
from remaster_ros.reports.report import answer_html, require_ready
from remaster_ros.reports.report_inputs import Inputs
from remaster_ros.reports.schemas import Fit, Judgement
from remaster_ros.session.records.plan_journal import ExpectationRecord, RecordedPlan


@pytest.fixture
def inputs(fit_result, tmp_path) -> Inputs:
    """A fit of two joints, with a plan of three poses to fit, two held out and a reference."""
    session = fit_result.session
    fit = msgspec.convert(msgspec.to_builtins(fit_content(fit_result)), Fit)
    fit.judgement = Judgement('good', 'The mean position error falls.')
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    rng = np.random.default_rng(0)

    def poses(count):
        q = rng.uniform(-1.5, 1.5, (count, 2, len(chain)))
        return tuple(
            PlannedPose(chain.forward(solution_set[0]), solution_set) for solution_set in q
        )

    plans = {
        FITTED: Plan(poses(3), {'unseen': 4}, {'unseen': 9, 'self-collision': 2}),
        'validation': Plan(poses(2), {'unseen': 1}, {'unseen': 1}),
        REFERENCE: Plan(poses(1)),
    }
    plan = RecordedPlan(Tour(chain, plans, reference_every=9), tmp_path / 's.plan.html')
    plan.outcomes = {(FITTED, 0, 0): 'recorded', (FITTED, 0, 1): 'partial'}
    plan.outcomes |= {(FITTED, 1, 0): 'no_free_path', (FITTED, 1, 1): 'rejected'}
    plan.outcomes |= {('validation', i, j): 'recorded' for i in range(2) for j in range(2)}
    plan.references.update(recorded=3, rejected=1)
    rows = len(session.measurements)
    return Inputs(session, fit, None, np.full(rows, 2.0), np.full(rows, 0.1), None, plan=plan)


def expected(inputs, factor):
    """Return inputs whose fit states the offsets `factor` times less well than was expected."""
    stds = {r.joint: r.std_if_exactly_drawn / factor for r in inputs.fit.joint_offsets}
    return replace(inputs, plan=replace(inputs.plan, expected=ExpectationRecord(stds, 2e-4)))


def test_what_was_planned_and_what_became_of_it(inputs):
    facts = plan_facts(inputs)
    fitted, held_out = facts.rows
    assert (fitted.poses, fitted.planned, fitted.recorded) == (3, 6, 2)
    assert fitted.lost == {'no free path': 1, 'rejected': 1, 'not visited': 2}
    assert (held_out.planned, held_out.recorded, held_out.lost) == (4, 4, {})
    assert facts.visits == 3
    assert facts.dropped == {'unseen': (5, 10), 'self-collision': (0, 2)}
    stamps = inputs.session.measurements.stamp_s
    assert facts.minutes == pytest.approx((stamps.max() - stamps.min()) / 60.0)
    assert (
        plan_facts(replace(inputs, session=replace(inputs.session, timed=False))).minutes is None
    )
    assert plan_facts(replace(inputs, plan=None)) is None
    assert plan_to_dict(facts)['dropped_configurations'] == {'unseen': 10, 'self-collision': 2}


@pytest.mark.parametrize(
    ('factor', 'words'),
    [(0.8, 'about as well'), (3.0, '3.0 times less well'), (0.25, '4.0 times better')],
)
def test_what_was_expected_stands_beside_what_came_out(inputs, factor, words):
    assert plan_facts(inputs).verdict == ''
    facts = plan_facts(expected(inputs, factor))
    rows = {row.joint: row for row in facts.stds}
    for row in inputs.fit.joint_offsets:
        found = rows[row.joint]
        drawn = np.degrees(row.std_if_exactly_drawn)
        assert found.expected == pytest.approx(drawn / factor)
        assert found.fit == (pytest.approx(drawn) if row.identifiable else None)
    assert words in facts.verdict


def test_a_wider_interval_for_other_errors_is_not_compared(inputs):
    """What is expected is of the model alone."""
    inputs = expected(inputs, 1.0)
    for row in inputs.fit.joint_offsets:
        row.model_std_deg = float(np.degrees(row.std_if_exactly_drawn))
        row.std_if_exactly_drawn_deg, row.std_deg = 3.0 * row.std_deg, 10.0 * row.std_deg
    assert plan_facts(inputs).ratio == pytest.approx(1.0)


def test_a_sensor_that_has_measured_nothing_is_in_no_picture(inputs):
    session = inputs.session
    sensors = {**session.sensors, 'unused': session.marker_names[0]}
    inputs = replace(inputs, session=replace(session, sensors=sensors))
    subject = Subject(inputs, answer_of(inputs), inputs.plan.tour.chain)
    drawn = draw_answer(subject)
    assert {'workspace', 'plan', 'session'} <= drawn.keys()
    assert all('unused' not in drawn[name] for name in ('workspace', 'plan'))
    assert 'id="plan"' in answer_html(subject, {})


def test_the_page_has_the_plan_its_picture_and_a_link_where_it_was_drawn(inputs):
    subject = Subject(expected(inputs, 3.0), answer_of(inputs), inputs.plan.tour.chain)
    html = answer_html(subject, {})
    assert '<a href="#plan">Plan</a>' in html
    assert '1 no free path, 1 rejected, 2 not visited' in html
    assert 'href="plan.html"' not in html
    # The picture has every pose, those that were not measured by a mark of their own.
    figure = planned(subject)
    lines = {line.get_marker(): line for line in figure.axes[0].lines[-4:]}
    assert [len(lines[marker].get_xdata()) for marker in 'osDx'] == [1, 2, 1, 2]
    name = fingerprint(inputs.plan.tour)
    head = f'<meta name="generator" content="remaster plan"><meta name="plan" content="{name}">'
    inputs.plan.page.write_text(head.replace(name, '00000000'))
    assert not drawn_plan(inputs.plan), 'of another plan'
    inputs.plan.page.write_text(head)
    assert 'href="plan.html"' in answer_html(subject, {})
    # Copied beside the page; one of an earlier report would contradict it.
    copy_plan(inputs.plan, inputs.plan.page.parent)
    copied = inputs.plan.page.with_name('plan.html')
    assert copied.read_text() == head
    require_ready(copied.parent, pdf=False)
    copy_plan(None, copied.parent)
    assert not copied.exists()
    copied.write_text('my own')
    with pytest.raises(InputError, match='no page of remaster plan'):
        require_ready(copied.parent, pdf=False)
    copied.unlink()
    printed = answer_html(subject, {}, printing=True)
    assert 'href="plan.html"' not in printed
    assert 'plan.html beside this report' in printed
    without = subject._replace(inputs=replace(inputs, plan=None))
    assert 'id="plan"' not in answer_html(without, {})
