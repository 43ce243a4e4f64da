# SPDX-License-Identifier: Apache-2.0
"""With `confirm: true` the arm of real nodes follows no plan that was not shown and confirmed."""

import pytest
from rigs.collection_rig import Cell
from rigs.ros_rig import call
from worlds.simple_cells import four_markers, write_cell

pytestmark = [pytest.mark.ros, pytest.mark.qualify, pytest.mark.timeout(900)]


@pytest.mark.parametrize('moving_s', [0.0, 24.0])
def test_nothing_moves_before_each_plan_is_confirmed(start, client, tmp_path, moving_s):
    """The registration, then the collection, then the same one with a planner started again.

    From pose to pose, and along curves at the pace of a real arm.
    """
    writes = four_markers if moving_s else write_cell
    path = writes(tmp_path / 'cell.yaml', confirm=True)
    # Stamps of another pace are further from the bridge's clock than curves allow.
    options = {'rate': 1.0, 'judged': {'moving_s': moving_s}} if moving_s else {}
    cell = Cell(start, client, tmp_path, 'mocap', ['mocap'], cell=path, collect=False, **options)
    page = tmp_path / 'session.plan.html'
    confirmed = []

    def planner(key):
        return cell.said.get('pose_planner', {}).get(key, '')

    def commanded():
        return cell.said['robot_bridge']['commanded']

    def confirm():
        """Look at the page, confirm the plan, and collect, in that order and no other."""
        cell.told_to_stand()
        before = commanded()
        refused = call(client, '/remaster/collect')
        assert not refused.success
        assert str(page) in refused.message
        assert '/remaster/confirm and /remaster/collect' in refused.message
        cell.until(lambda: planner('plan_page') == str(page), 'the page')
        assert planner('confirmed') == 'no'
        refused = call(client, '/remaster/collect').message
        assert ' is not confirmed: look at ' in refused
        plan = refused.split()[1]
        assert f'confirmation of plan {plan}' in page.read_text(encoding='utf-8')
        assert commanded() == before
        assert planner('state') != 'running'
        answer = call(client, '/remaster/confirm')
        assert answer.success, answer.message
        assert answer.message.startswith(f'plan {plan} is confirmed')
        confirmed.append(plan)
        answer = call(client, '/remaster/collect')
        assert answer.success, answer.message

    confirm()
    assert 'for the registration' in page.read_text(encoding='utf-8')
    cell.until(lambda: planner('state') == 'paused', 'the pause before the collection')
    registered = len(cell.results)
    confirm()
    assert 'for the registration' not in page.read_text(encoding='utf-8')
    cell.until(lambda: len(cell.results) > registered, 'the first configuration')
    # A pause keeps the confirmation.
    assert call(client, '/remaster/pause').success
    answer = call(client, '/remaster/collect')
    assert answer.success, answer.message
    cell.said.pop('pose_planner')
    cell.kill_and_start('pose_planner')
    cell.until(lambda: planner('robot') == 'heard', 'the planner')
    assert planner('resuming') == 'no'
    confirm()
    cell.check(cell.complete())
    first, second, third = confirmed
    assert first != second
    assert second == third
