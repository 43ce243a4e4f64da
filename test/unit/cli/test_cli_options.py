# SPDX-License-Identifier: Apache-2.0
"""Option values that cannot be are refused with one line that names option and value."""

import argparse

import pytest

from remaster_ros.cli.options import Parser, integer, names, number


def test_what_can_be_is_taken():
    assert integer(2)('3') == 3
    assert number()('0.25') == 0.25
    assert number(1.0, 20.0)('20') == 20.0
    assert names('mocap, tracker') == ('mocap', 'tracker')


@pytest.mark.parametrize(
    ('convert', 'text', 'words'),
    [
        (integer(0), '-1', '-1 is less than 0'),
        (integer(0), '1.5', 'not a whole number'),
        (integer(0), '', 'not a whole number'),
        (number(), 'nan', 'nan is not a finite number'),
        (number(), 'inf', 'inf is not a finite number'),
        (number(unit='mm'), '-0.1', '-0.1 is less than 0 mm'),
        (number(high=1.0), '1.01', '1.01 is more than 1'),
        (number(), 'much', 'not a number'),
        (names, 'mocap,', 'no list of names'),
        (names, '', 'no list of names'),
        (names, 'mocap,mocap', 'twice'),
    ],
)
def test_what_cannot_be_is_refused(convert, text, words):
    with pytest.raises(argparse.ArgumentTypeError, match=words):
        convert(text)


def parser():
    parser = Parser(prog='remaster')
    parser.add_argument('--noise-mm', type=number(unit='mm'))
    return parser


@pytest.mark.parametrize(
    ('argv', 'words'),
    [
        (['--noise-mm', '-1'], 'argument --noise-mm: -1 is less than 0 mm'),
        (['--noise', '1'], 'unrecognized arguments'),
    ],
)
def test_a_usage_error_is_one_line_and_status_2(argv, words, capsys):
    with pytest.raises(SystemExit) as stop:
        parser().parse_args(argv)
    assert stop.value.code == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert err.startswith('error: ')
    assert err.count('\n') == 1
    assert words in err
    assert 'remaster --help' in err
