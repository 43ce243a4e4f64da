# SPDX-License-Identifier: Apache-2.0
"""Programs and logs in the text of makers of controllers, for the tests: joints by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Kind:
    """One kind of text: how it is written, and what its language takes for comments.

    Attributes
    ----------
    write
        Names and joints, deg, (n, k) -> text.
    named
        Whether the names stand in it.
    comment
        What begins a comment; '' where nothing does.
    one_line
        Whether each position is a line.
    """

    write: Callable[[Sequence[str], np.ndarray], str]
    named: bool = True
    comment: str = ''
    one_line: bool = True


def _kuka(q: np.ndarray, between: str) -> str:
    axes = [f'A{i} {value:.4f}' for i, value in enumerate(q, 1)]
    return between.join([*axes, *[f'E{i} 0.0' for i in range(1, 7)]])


def kuka_dat(names, q):
    lines = ['&ACCESS RVP', '&REL 4', 'DEFDAT calib', 'EXTERNAL DECLARATIONS']
    for name, row in zip(names, q):
        lines += [f'DECL E6AXIS X{name}={{{_kuka(row, ",")}}}']
        lines += [f'DECL FDAT F{name}={{TOOL_NO 1,BASE_NO 0,IPO_FRAME #BASE,POINT2[] " "}}']
    return '\r\n'.join(
        [*lines, 'DECL E6POS XAWAY={X 1.0,Y 2.0,Z 3.0,A 0.0,B 0.0,C 0.0}', 'ENDDAT']
    )


def kuka_src(names, q):
    moves = [f'PTP {{E6AXIS: {_kuka(row, ", ")}}}\r\nWAIT SEC 5' for row in q]
    return '\r\n'.join(['DEF calib( )', ';FOLD INI', 'BAS (#INITMOV,0)', *moves, 'END'])


def kuka_log(names, q):
    return '\n'.join(f'$AXIS_ACT={{E6AXIS: {_kuka(row, ", ")}}}' for row in q)


def fanuc(names, q):
    lines = ['/PROG  CALIB', '/ATTR', f'LINE_COUNT\t= {len(q)};', '/MN']
    lines += [f'{i:4d}:J {name} 10% FINE    ;' for i, name in enumerate(names, 1)]
    lines += ['/POS']
    for i, row in enumerate(q, 1):
        axes = [f'J{i}= {value:9.4f} deg' for i, value in enumerate(row, 1)]
        lines += [f'P[{i}]{{', '   GP1:', '\tUF : 0, UT : 1,']
        lines += ['\t' + ',\t'.join(axes[:3]) + ',', '\t' + ',\t'.join(axes[3:]), '};']
    return '\r\n'.join([*lines, '/END'])


def rapid(names, q):
    lines = ['MODULE calib', '  ! measured', '  VAR jointtarget here;']
    for name, row in zip(names, q):
        axes = ','.join(f'{value:.4f}' for value in row)
        lines += [f'  CONST jointtarget {name}:=[[{axes}],[9E9,9E9,9E9,9E9,9E9,9E9]];']
    lines += ['  CONST robtarget away:=[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];']
    return '\n'.join([*lines, '  PROC main()', '    MoveAbsJ here, v100, fine, tool0;', 'ENDPROC'])


def rapid_log(names, q):
    unused = ','.join(['9E+09'] * 6)
    return '\n'.join(f'[[{",".join(f"{v:.4f}" for v in row)}],[{unused}]]' for row in q)


def rokae(names, q):
    rows = zip(names, (','.join(f'{value:.4f}' for value in row) for row in q), strict=True)
    return '\n'.join(f'GLOBAL CONST jointtarget {name} = J:{{{row}}};' for name, row in rows)


def staubli(names, q):
    lines = ['<?xml version="1.0" encoding="utf-8"?>', '<Database>', '  <Datas>']
    for name, row in zip(names, q):
        axes = ' '.join(f'j{i}="{value:.4f}"' for i, value in enumerate(row, 1))
        lines += [f'    <Data name="{name}" xsi:type="array" type="jointRx" size="1">']
        lines += [f'      <Value key="0" {axes} />', '    </Data>']
    return '\n'.join([*lines, '  </Datas>', '</Database>'])


def ur_script(names, q):
    lines = ['def calib():', '  set_tcp(p[0.0,0.0,0.1,0.0,0.0,0.0])', '  global grav=[0, 0, 9.82]']
    for name, row in zip(names, np.deg2rad(q)):
        lines += [f'  global {name}_q=[{", ".join(f"{value:.8f}" for value in row)}]']
    lines += [f'  movej({name}_q, a=1.4, v=1.05)' for name in names]
    return '\n'.join([*lines, '  movel(p[0.1,0.2,0.3,0,0,0], a=1.2)', 'end'])


def ur_moves(names, q):
    rows = ([f'{value:.8f}' for value in row] for row in np.deg2rad(q))
    return '\n'.join(['def calib():', *[f'  movej([{", ".join(r)}], a=1.4)' for r in rows], 'end'])


def kuka_named_log(names, q):
    return '\n'.join(f'{name}: {{E6AXIS: {_kuka(row, ", ")}}}' for name, row in zip(names, q))


def yaskawa(names, q):
    lines = ['/JOB', '//NAME CALIB', '//POS', f'///NPOS {len(q)},0,0,0,0,0', '///TOOL 0']
    lines += ['///POSTYPE ANGLE', '///ANGLE']
    lines += [f'{n}={",".join(f"{v:.4f}" for v in row)}' for n, row in zip(names, q)]
    lines += ['//INST', '///DATE 2026/03/05 10:00', 'NOP', 'END']
    return '\n'.join(lines) + '\n'


def fanuc_registers(names, q):
    lines = [
        f'[*POSREG*]$POSREG  Storage: SHADOW  Access: RW  : ARRAY[1,{len(q) + 2}] OF Position Reg'
    ]
    for i, row in enumerate(q, 1):
        axes = [f'J{j} = {value:9.4f} deg' for j, value in enumerate(row, 1)]
        lines += [f"    [1,{i}] =   'calib {i}'   Group: 1"]
        lines += [f'  {"   ".join(axes[:3])} ', f'  {"   ".join(axes[3:])} ', '']
    lines += [f"    [1,{len(q) + 1}] =   '' Uninitialized", f"    [1,{len(q) + 2}] =   'away' "]
    lines += [
        '  Group: 1   Config: N U T, 0, 0, 0',
        '  X:  -820.507   Y:  2309.503   Z:   945.836',
    ]
    return '\n'.join([*lines, '  W:    90.594   P:    -1.149   R:  -160.248', ''])


def kawasaki(names, q):
    lines = ['.PROGRAM calib()', *(f'  JMOVE #{name}' for name in names), '.END', '.JOINTS']
    lines += [f'#{n} {" ".join(f"{v:.6f}" for v in row)}' for n, row in zip(names, q)]
    return '\n'.join([*lines, '.END', '.TRANS', 't1 500.0 0.0 600.0 0.0 180.0 0.0', '.END', ''])


def doosan(names, q):
    lines = [f'{n} = posj({", ".join(f"{v:.4f}" for v in row)})' for n, row in zip(names, q)]
    lines += ['away = posx(400, 0, 500, 0, 180, 0)']
    return '\n'.join([*lines, *(f'movej({name}, v=30, a=30)' for name in names), ''])


def polyscope(names, q):
    lines = ['<?xml version="1.0"?>', '<URProgram name="calib">', '<children>']
    for name, row in zip(names, np.deg2rad(q)):
        lines += [f'<Waypoint type="Fixed" name="{name}">', '<position>']
        lines += [f'<JointAngles angles="{", ".join(f"{v:.8f}" for v in row)}"/>']
        lines += ['<TCPOffset pose="0.0, 0.0, 0.0, 0.0, 0.0, 0.0"/>', '</position>', '</Waypoint>']
    return '\n'.join([*lines, '</children>', '</URProgram>', ''])


def calls(names, q):
    rows = (', '.join(f'{value:.4f}' for value in row) for row in q)
    return '\n'.join(f'MoveJoints({row})\nDelay(2)' for row in rows) + '\n'


def keyed(names, q):
    rows = (', '.join(f'J{i} = {v:.4f} deg' for i, v in enumerate(row, 1)) for row in q)
    return 'calibration\n' + ''.join(f'{name}: {row}\n' for name, row in zip(names, rows))


def rapid_named_log(names, q):
    unused = ','.join(['9E+09'] * 6)
    rows = (','.join(f'{value:.4f}' for value in row) for row in q)
    return '\n'.join(f'{n}: [[{row}],[{unused}]]' for n, row in zip(names, rows)) + '\n'


KINDS = {
    'kuka_dat': Kind(kuka_dat, comment=';'),
    'kuka_src': Kind(kuka_src, named=False, comment=';'),
    'kuka_log': Kind(kuka_log, named=False, comment=';'),
    'fanuc': Kind(fanuc, one_line=False),
    'rapid': Kind(rapid, comment='!'),
    'rapid_log': Kind(rapid_log, named=False, comment='!'),
    'rokae': Kind(rokae, comment='!'),
    'staubli': Kind(staubli, one_line=False),
    'kuka_named_log': Kind(kuka_named_log, comment=';'),
    'yaskawa': Kind(yaskawa),
    'fanuc_registers': Kind(fanuc_registers, one_line=False),
    'kawasaki': Kind(kawasaki, comment=';'),
    'doosan': Kind(doosan, comment='#'),
    'ur_polyscope': Kind(polyscope, one_line=False),
    'calls': Kind(calls, named=False),
    'keyed': Kind(keyed),
    'rapid_named_log': Kind(rapid_named_log),
    'ur_script': Kind(ur_script, comment='#'),
    'ur_moves': Kind(ur_moves, named=False, comment='#'),
}


def names_of(kind: str, count: int) -> list[str]:
    """Return what a kind calls its positions."""
    name = {'fanuc': 'P[{}]', 'fanuc_registers': 'PR[{}]'}.get(kind, 'P{}')
    return [name.format(i) for i in range(1, count + 1)]
