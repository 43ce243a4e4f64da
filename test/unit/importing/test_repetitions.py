# SPDX-License-Identifier: Apache-2.0
"""No reader of a maker's text takes longer than its length says, whatever is repeated in it.

An expression with two ways to match the same text tries them all where the text ends otherwise.
Judged by the time for twice the length, in the same process: no absolute time.
"""

import time
from contextlib import suppress

import pytest

from remaster_ros.errors import InputError
from remaster_ros.importing.makers import READERS

HEADS = (
    '',
    'x = [',
    'P1: [',
    'movej([1,2,3,4,5,6])\nx = [',
    'DEF a()\n{E6AXIS: A1 ',
    'MODULE a\nCONST jointtarget j:=',
    'CONST jointtarget j{3}:=[',
    'PR[1]{ GP1: J1= ',
    '<a j1="1" ',
    'Format Version,1.23,\n',
    '*11....+0000000A ',
    '/JOB\n///POSTYPE ANGLE\nC0=',
    '%time,field.name0,field.position0\n',
)
REPEATED = ('(', '[', ' ', '\t', '1', 'a ', '] [', '[1,2,3,4,5,6] ', '1,', 'J1= 1 deg ', 'j1="1" ')
LENGTH = 3000
# Of a length squared four, cubed eight, with every way tried more than anybody waits.
MOST_TIMES, SOON_S = 6.0, 0.2


def seconds(read, text):
    begun = time.process_time()
    with suppress(InputError):
        read(text)
    return time.process_time() - begun


@pytest.mark.timeout(300)
@pytest.mark.parametrize('read', READERS, ids=lambda read: read.__module__.split('.')[-1])
def test_what_is_repeated_is_read_or_refused_in_time(read):
    for head in HEADS:
        for part in REPEATED:
            once, twice = (head + part * (n // len(part)) + '!\n' for n in (LENGTH, 2 * LENGTH))
            first, second = seconds(read, once), seconds(read, twice)
            assert second < max(SOON_S, MOST_TIMES * first), (head, part)
