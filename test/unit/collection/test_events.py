# SPDX-License-Identifier: Apache-2.0
"""The records that the nodes act on: what comes back is what was sent, or one clear error."""

import json
import types
from typing import Annotated, Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from remaster_ros.collection import events
from remaster_ros.collection.events import (
    STATES,
    BridgeState,
    ConfigurationEnded,
    EventRecord,
    PlannerState,
    PoseAnnounced,
    RecorderState,
    decode,
    encode,
)
from remaster_ros.errors import InputError

BODIES = (*STATES, *get_args(events.Event))
# JSON in a ROS string holds any text but lone surrogates.
TEXT = st.text(st.characters(exclude_categories=['Cs']), max_size=20)


def values(kind):
    """Return a strategy of the values that a field of this type may have."""
    arguments = get_args(kind)
    match get_origin(kind) or kind:
        case types.UnionType:
            return st.one_of(*map(values, arguments))
        case _ if get_origin(kind) is Annotated:
            return st.integers(0, 2**31)
        case _ if get_origin(kind) is Literal:
            return st.sampled_from(arguments)
        case plain if plain is types.NoneType:
            return st.none()
        case plain if plain is bool:
            return st.booleans()
        case plain if plain is int:
            return st.integers(-(2**63), 2**63 - 1)
        case plain if plain is float:
            return st.floats(allow_nan=False, allow_infinity=False)
        case plain if plain is str:
            return TEXT
        case plain if plain is tuple:
            return st.lists(values(arguments[0]), max_size=4).map(tuple)
        case plain if plain is dict:
            return st.dictionaries(TEXT, values(arguments[1]), max_size=3)
        case struct:
            return bodies(struct)


def bodies(kind):
    fields = get_type_hints(kind, include_extras=True)
    fields = {name: fields[name] for name in kind.__struct_fields__}
    return st.builds(kind, **{name: values(field) for name, field in fields.items()})


@st.composite
def records(draw):
    body = draw(st.sampled_from(BODIES).flatmap(bodies))
    namespace = draw(st.sampled_from(['', '/left', '/a/b']))
    return EventRecord(
        node=f'{namespace}/{body.sender or "some_node"}',
        body=body,
        started=draw(TEXT),
        uptime_s=draw(st.floats(0.0, 1e9)),
        stamp_ns=draw(st.integers(0, 2**62)),
    )


@given(records())
def test_what_was_sent_comes_back(record):
    assert decode(encode(record)) == record


@given(records(), st.dictionaries(TEXT.map('new_{}'.format), st.integers() | TEXT, max_size=3))
def test_fields_that_this_version_does_not_know_are_ignored(record, more):
    content = json.loads(encode(record))
    content.update(more)
    content['body'].update(more)
    assert decode(json.dumps(content)) == record


@given(records(), st.integers(-3, 9).filter(lambda version: version != events.VERSION))
def test_another_version_is_refused_whatever_it_holds(record, version):
    content = json.loads(encode(record))
    for body in (content['body'], {'kind': 'of the future'}, None):
        text = json.dumps({**content, 'version': version, 'body': body})
        with pytest.raises(InputError, match=rf'version {version}, and this program reads'):
            decode(text)


@settings(max_examples=300)
@given(records(), st.data())
def test_damaged_text_is_refused_or_is_another_record(record, data):
    text = encode(record)
    begin = data.draw(st.integers(0, len(text)))
    end = data.draw(st.integers(begin, min(begin + 8, len(text))))
    try:
        found = decode(text[:begin] + data.draw(TEXT) + text[end:])
    except InputError:
        return
    assert found.version == events.VERSION
    assert found.body.sender in ('', found.node.rpartition('/')[2])


@given(st.text())
def test_any_text_is_refused_with_one_kind_of_error(text):
    with pytest.raises(InputError, match='damaged record'):
        decode(text)


def test_what_nests_without_end_is_refused():
    with pytest.raises(InputError, match='damaged record'):
        decode('{"version": 1, "x": ' + '[' * 100_000)


@pytest.mark.parametrize(
    ('body', 'field'),
    [
        (PlannerState(state='running', run='a'), 'state'),
        (PlannerState(state='running', run='a'), 'run'),
        (BridgeState(halted=''), 'halted'),
        (RecorderState(waiting_for=''), 'waiting_for'),
        (ConfigurationEnded(stamp='1', solution=0, result='recorded'), 'stamp'),
        (ConfigurationEnded(stamp='1', solution=0, result='recorded'), 'solution'),
        (PoseAnnounced(stamp='1', pose=0, split='optimization', ids=(0,)), 'ids'),
    ],
)
def test_a_field_that_lets_the_arm_move_cannot_be_left_out(body, field):
    content = json.loads(encode(EventRecord(node=f'/{body.sender}', body=body)))
    assert decode(json.dumps(content)).body == body
    del content['body'][field]
    with pytest.raises(InputError, match=f'`{field}`'):
        decode(json.dumps(content))


@pytest.mark.parametrize('kind', [kind for kind in BODIES if kind.sender])
@given(data=st.data())
@settings(max_examples=5)
def test_no_other_node_can_publish_it(kind, data):
    body = data.draw(bodies(kind))
    with pytest.raises(InputError, match=f'but for {kind.sender}'):
        decode(encode(EventRecord(node=f'/{kind.sender}/stranger', body=body)))


def test_numbers_of_numpy_are_written_as_numbers():
    body = events.SolutionCommanded(
        stamp='1', solution=np.int64(2), since_settled_wall_s=np.float64(0.5)
    )
    assert decode(encode(EventRecord(node='/robot_bridge', body=body))).body == body


def test_every_kind_has_its_own_name():
    names = [kind.__struct_config__.tag for kind in BODIES]
    assert len(set(names)) == len(names)
    # As they stand in bags: another name needs another version.
    assert json.loads(encode(EventRecord(node='/x', body=events.Alive()))) == {
        'node': '/x',
        'body': {'kind': 'alive'},
        'started': '',
        'uptime_s': 0.0,
        'stamp_ns': 0,
        'model': None,
        'version': 1,
    }


@pytest.mark.parametrize(
    ('token', 'state', 'run', 'after'),
    [
        ('', 'running', 'a', 'a'),
        ('a', 'running', 'b', 'b'),
        # Waiting for room on the disk is a part of the run.
        ('a', 'held', 'a', 'a'),
        # A planner that was started again, and has not decided whether the run still lives.
        ('a', 'idle', '', 'a'),
        # Of another version, or a stand-in.
        ('a', 'running', '', 'a'),
        # Ended: whoever is started again must not go on.
        ('a', 'paused', '', ''),
        ('a', 'stopped', '', ''),
        ('a', 'failed', '', ''),
        ('a', 'complete', '', ''),
        # A token counts in a run alone.
        ('', 'idle', 'a', ''),
    ],
)
def test_the_token_lives_as_long_as_the_run(token, state, run, after):
    assert PlannerState(state=state, run=run).run_held(token) == after


# Bags of older versions
