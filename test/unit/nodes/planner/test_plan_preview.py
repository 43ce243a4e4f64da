# SPDX-License-Identifier: Apache-2.0
"""The arm follows no plan that a person has not looked at, where the cell asks for that."""

import dataclasses
import threading
import time

import numpy as np
import pytest
from worlds.simple_cells import write_cell

from remaster_ros.collection.events import Decided
from remaster_ros.collection.peers import Peers
from remaster_ros.collection.plan_confirmation import PlanConfirmation, fingerprint
from remaster_ros.collection.tour_progress import TourProgress
from remaster_ros.nodes.background import PlanningThread
from remaster_ros.nodes.planner.plan_preview import PlanPreview
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.records.plan_journal import PlanJournal

START = np.deg2rad([5.0, 7.0, 0.0, 112.0, 10.0, 35.0, -20.0])
COUNTS = {'optimization': 3, 'validation': 2, 'registration': 6}


class Beside:
    """A thread for each work, whose result is taken there: there is no node to take it."""

    def submit(self, work, then):
        def do():
            try:
                result = work()
            except Exception as error:
                result = error
            then(result)

        threading.Thread(target=do, daemon=True).start()


class Bench:
    """What a planner's node has, without the node."""

    def __init__(self, folder, confirm=True):
        cell = read_cell(write_cell(folder / 'cell.yaml', confirm=confirm))
        self.chain = cell.chain()
        self.tours = TourPlanner(
            cell.planning_scene(self.chain), COUNTS, 0, design=cell.design_settings()
        )
        self.journal = PlanJournal(folder / 'session', {}, self.chain, self.tours.model)
        self.progress = TourProgress(self.journal, self.tours, PlanningThread(Beside()))
        self.peers = Peers(cell.sensors)
        self.preview = PlanPreview(
            cell, self.tours, self.journal, self.progress, folder / 'session', Beside()
        )
        self.page = folder / 'session.plan.html'

    def draw(self):
        """Draw what is next; return what a person is told."""
        until = time.monotonic() + 60.0
        while not (message := self.preview.draw(START, self.peers)):
            assert time.monotonic() < until
            time.sleep(0.01)
        return message

    def registered(self):
        self.progress.T_R_N.update(self.tours.rough_places)


@pytest.fixture
def bench(tmp_path):
    return Bench(tmp_path)


def test_the_plan_is_shown_and_followed_only_once_it_is_confirmed(bench):
    preview = bench.preview
    assert 'it is being drawn' in preview.collect_refusal()
    assert preview.confirm() == (False, preview.refusal())
    message = bench.draw()
    registration = bench.tours.registration()
    name = fingerprint(registration)
    assert message == preview.collect_refusal()
    assert message == (
        f'plan {name} is not confirmed: look at {bench.page}, then call /remaster/confirm and '
        '/remaster/collect'
    )
    html = bench.page.read_text(encoding='utf-8')
    assert f'confirmation of plan {name}' in html
    assert 'for the registration' in html
    assert f'ros2 service call /remaster/confirm/plan_{name} std_srvs' in html
    assert not preview.allows(registration)
    assert preview.confirm()[0]
    assert preview.collect_refusal() == ''
    assert preview.allows(registration)
    assert not preview.allows(None)
    # Nothing new: the page stays as it is.
    before = bench.page.stat().st_mtime_ns
    for _ in range(5):
        assert preview.draw(START, bench.peers) == ''
    assert bench.page.stat().st_mtime_ns == before


def test_another_plan_needs_another_confirmation(bench):
    preview = bench.preview
    bench.draw()
    preview.confirm()
    collection = bench.tours.collection(bench.tours.rough_places)
    assert not preview.allows(collection)
    bench.registered()
    # From now on the page is out of date, and cannot be confirmed.
    assert preview.draw(START, bench.peers) == ''
    assert not preview.confirm()[0]
    assert 'it is being drawn' in preview.collect_refusal()
    assert fingerprint(collection) in bench.draw()
    assert not preview.allows(collection)
    assert 'for the registration' not in bench.page.read_text(encoding='utf-8')
    assert preview.confirm()[0]
    assert preview.allows(collection)
    assert not preview.allows(bench.tours.registration())
    # As the node takes it up and pauses in the middle: still the same plan.
    bench.journal.begin(collection)
    bench.progress.phase = 'collection'
    stop = collection.next(START)
    bench.journal.open_visit(stop)
    bench.progress.decided = Decided(stop.pose, stop.ids[:1])
    assert preview.draw(START, bench.peers) == ''
    assert preview.collect_refusal() == ''
    assert preview.allows(bench.journal.tour)


def test_a_planner_started_again_has_no_confirmation(bench, tmp_path):
    collection = bench.tours.collection(bench.tours.rough_places)
    bench.registered()
    bench.draw()
    bench.preview.confirm()
    bench.journal.begin(collection)
    stop = collection.next(START)
    bench.journal.open_visit(stop)
    bench.journal.close()
    again = Bench(tmp_path)
    again.progress.decided = Decided(stop.pose, stop.ids[:1])
    assert not again.preview.allows(again.journal.tour)
    # The same plan, of which the page has what is left.
    name = fingerprint(again.journal.tour)
    assert name == fingerprint(collection)
    assert name in again.draw()
    total = sum(len(pose.solutions) for plan in collection.plans.values() for pose in plan.poses)
    assert f'<p>{total - 1} configurations at ' in again.page.read_text(encoding='utf-8')
    assert not again.preview.allows(again.journal.tour)
    again.journal.close()


def test_only_the_plan_that_a_person_has_seen_is_confirmed(bench):
    """Its name says which; without a name, none that has taken the place of another."""
    preview = bench.preview
    bench.draw()
    first = fingerprint(bench.tours.registration())
    assert preview.values() == {
        'plan_page': str(bench.page),
        'plan_shown': first,
        'confirmed': 'no',
    }
    done, why = preview.confirm('00000000')
    assert not done
    assert why.startswith('plan 00000000 is not the one that is next; plan ')
    bench.registered()
    preview.draw(START, bench.peers)
    # While the next one is drawn, no name is right.
    assert not preview.confirm(first)[0]
    bench.draw()
    second = fingerprint(bench.tours.collection(bench.tours.rough_places))
    assert preview.shown == second
    assert not preview.confirm(first)[0]
    done, why = preview.confirm()
    assert not done
    assert f'look at {bench.page} again, then call /remaster/confirm/plan_{second}' in why
    assert preview.confirmed == ''
    assert preview.confirm(second)[0]
    assert preview.values()['confirmed'] == 'yes'
    # A request for the first one that was held up on its way changes nothing.
    assert not preview.confirm(first)[0]
    assert preview.confirmed == second
    assert preview.confirm()[0]


def test_a_page_that_cannot_be_written_holds_the_arm_and_is_tried_again(bench):
    bench.page.write_text('my own')
    message = bench.draw()
    assert message.startswith('the plan cannot be shown: ')
    assert str(bench.page) in message
    assert not bench.preview.confirm()[0]
    bench.page.unlink()
    assert bench.preview.collect_refusal() == message
    assert 'is not confirmed: look at' in bench.draw()


def test_cells_that_do_not_ask_for_it_go_without(tmp_path):
    bench = Bench(tmp_path, confirm=False)
    assert bench.preview.draw(START, bench.peers) == ''
    assert bench.preview.collect_refusal() == ''
    assert bench.preview.allows(bench.tours.registration())
    done, why = bench.preview.confirm()
    assert not done
    assert 'confirm: true' in why
    assert not bench.page.exists()


def test_asking_for_a_confirmation_leaves_plans_as_they_are(tmp_path):
    plain, asking = (
        read_cell(write_cell(tmp_path / f'{confirm}.yaml', confirm=confirm))
        for confirm in (False, True)
    )
    assert plain.fingerprint() == asking.fingerprint()


def test_any_other_configuration_or_order_is_another_plan(bench):
    tour = bench.tours.registration()
    name = fingerprint(tour)
    assert name == fingerprint(bench.tours.registration())
    confirmation = PlanConfirmation(True, 'page')
    confirmation.show(name)
    confirmation.confirm()
    assert confirmation.allows(tour)
    plan = tour.plans['registration']
    moved = dataclasses.replace(plan.poses[0], solutions=plan.poses[0].solutions + 1e-9)
    for poses in (plan.poses[1:], plan.poses[::-1], (moved, *plan.poses[1:])):
        other = tour.fork()
        other.plans = {'registration': dataclasses.replace(plan, poses=poses)}
        assert not confirmation.allows(other)


def test_poses_to_judge_by_are_shown_and_confirmed_like_any_other(bench):
    """They are planned before they can be shown: nothing was announced by then."""
    bench.draw()
    bench.progress.inspection = bench.tours.verification
    until = time.monotonic() + 60.0
    required = bench.peers.required()
    while (stop := bench.progress.next(START, required, '')) is None:
        assert time.monotonic() < until
        time.sleep(0.01)
    assert stop.correction in ('on', 'off')
    assert not bench.preview.allows(bench.journal.tour)
    bench.preview.withdraw()
    name = fingerprint(bench.journal.tour)
    assert name in bench.draw()
    assert 'none is fitted, they are for /remaster/verify' in bench.page.read_text()
    assert bench.preview.confirm(name)[0]
    assert bench.preview.allows(bench.journal.tour)
