# SPDX-License-Identifier: Apache-2.0
"""Robot descriptions of somebody who means harm: refused in one line, and nothing is done."""

import logging
import os
import time
from pathlib import Path

import numpy as np
import pytest

from remaster_ros.errors import InputError
from remaster_ros.session.cells import robot_description
from remaster_ros.session.cells.meshes import find_mesh, read_mesh
from remaster_ros.session.cells.robot_description import read_arm, read_description
from remaster_ros.session.cells.xacro_expressions import ExpressionError, evaluate, global_names

NAMESPACE = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
# What xacro's own guard lets through: it looks at the names of the outer code alone.
POPEN = "[c for c in ().__class__.__base__.__subclasses__() if c.__name__ == 'Popen'][0]"
SHELL = f"(lambda: {POPEN}('touch {{canary}}', shell=True).wait())()"


def robot(body, head=''):
    return f'<?xml version="1.0"?>{head}<robot name="r" {NAMESPACE}>{body}</robot>'


# Expressions by what they try. Those with a canary would leave the file if they were run.
EXPRESSIONS = {
    'shell': SHELL,
    'lambda': f'(lambda: {SHELL})()',
    'lambda in a lambda': f'(lambda f: f())(lambda: {SHELL})',
    'comprehension': f'[{SHELL} for i in [1]]',
    'generator': f'list({SHELL} for i in [1])',
    'default of a lambda': f'(lambda x={SHELL}: x)()',
    'subclasses': f"{POPEN}('touch {{canary}}', shell=True)",
    'import': "__import__('os').system('touch {canary}')",
    'class of a number': '(1).__class__',
    'class of a text': "'a'.__class__.__mro__",
    'class by getattr': "getattr((), '__class__')",
    'vars': 'python.vars(math)',
    'type': "python.type('X', (), {'a': 1})",
    'globals of a function': "xacro.load_yaml.__globals__['os'].system('touch {canary}')",
    'globals of a lambda': "(lambda: 0).__globals__['os'].system('touch {canary}')",
    'call of a function': 'radians.call',
    'what a function is': 'str(radians)',
    'map with a function': 'list(map(str, [1]))',
    'sorted by a function': 'sorted([2, 1], key=str)',
    'the builtins': "__builtins__['open']('{canary}', 'w')",
    'open': "open('{canary}', 'w')",
    'eval': "eval('1')",
    'exec': "exec('import os')",
    'format': "'{0.__class__}'.format(1)",
    'format by a map': "'{a.__class__}'.format_map(dict(a=1))",
    'percent': "'%100000000d' % 1",
    'formatted string': "f'{1!r:>100000000}'",
    'assignment': '(x := 1)',
    'await': '(await x)',
    'star': 'max(*[1, 2])',
    'double star': "dict(**{'a': 1})",
    'set': '{1, 2}',
    'bytes': "b'abc'",
    'complex': '1j',
    'ellipsis': '...',
    'bits': '1 << 100000000',
    'power of powers': '9**9**9**9',
    'power': '(10**100)**100',
    'power of a fraction': '(-8)**0.5',
    'product': "'a' * 10**9",
    'nested products': '[[0] * 9999] * 9999',
    'range': 'range(10**12)',
    'pad': "'a'.ljust(10**9)",
    'join': "'a'.join(['b'])",
    'replace': "('a' * 90000).replace('a', 'a' * 90000)",
    'factorial': 'math.factorial(10**7)',
    'attribute of the table': 'xacro.parent',
    'method of a dictionary': 'dict(a=1).items()',
    'environment': "env('HOME')",
    'deep': '(' * 5000 + '1' + ')' * 5000,
    'deeper': '-' * 50_000 + '1',
    'long': '1' + '+1' * 40_000,
    'huge number': '9' * 5000,
    'unknown': 'nothing',
    'statement': 'import os',
    'two lines': '1\n2',
}


@pytest.mark.parametrize('name', EXPRESSIONS)
def test_an_expression_that_is_more_than_arithmetic_is_not_evaluated(name, tmp_path):
    canary = tmp_path / 'canary'
    before = time.process_time()
    with pytest.raises(ExpressionError) as refused:
        evaluate(EXPRESSIONS[name].replace('{canary}', str(canary)), global_names())
    assert str(refused.value)
    assert time.process_time() - before < 5.0
    assert not canary.exists()


@pytest.mark.parametrize(
    ('expression', 'value'),
    [
        ('2 * pi / 3', 2 * np.pi / 3),
        ('radians(-90) + math.radians(90)', 0.0),
        ('1e-3 ** 2 // 1 % 7', 0.0),
        ("'a' + 'b' if not 1 > 2 >= 0 or False else 3", 'ab'),
        ("xyz.split(' ')[1]", '2'),
        ("name.startswith('ur') and 'r' in name", True),
        ("config['a']['b'] + config.a.b", 6),
        ('dict(a=1, b=2)', {'a': 1, 'b': 2}),
        ("{'a': [1, (2, 3)]}['a'][1][0]", 2),
        ('[1, 2, 3][::-1] + [4]', [3, 2, 1, 4]),
        ('max(len(str(abs(-12))), round(1.26, 1))', 2),
        ("-min([3, float('2.5')]) * (1, 2)[-1]", -5.0),
        ('python.sum(range(4)) + python.int(2.9)', 8),
        ('None is None and True', True),
        ('round(5, -10**9)', 0),
    ],
)
def test_what_real_descriptions_have_is_evaluated(expression, value):
    names = {'xyz': '1 2 3', 'name': 'ur5e', 'config': {'a': {'b': 3}}, **global_names()}
    assert evaluate(expression, names) == pytest.approx(value)


# Whole descriptions. CALL is an expression that would run the shell, SECRET a file that lies
# outside, CANARY one that is not there.
CALL = f'${{(lambda: {SHELL})()}}'
# Where the shell is called.
CALLED = {
    'an attribute': '<link name="CALL"/>',
    'a text': '<a>CALL</a>',
    'a property': '<xacro:property name="p" value="CALL"/><a b="${p}"/>',
    'an eager property': '<xacro:property name="p" value="CALL" lazy_eval="false"/>',
    'an argument': f'<xacro:arg name="a" default="{CALL[2:-1]}"/><link name="${{$(arg a)}}"/>',
    'a condition': '<xacro:if value="CALL"><a/></xacro:if>',
    'a default of a macro': f'<xacro:macro name="m" params="p:=${{(lambda:{SHELL})()}}">'
    '<a b="${p}"/></xacro:macro><xacro:m/>',
    'nested macros': '<xacro:macro name="m" params="p"><a b="CALL"/></xacro:macro>'
    '<xacro:macro name="n" params="q"><xacro:m p="${q}"/></xacro:macro><xacro:n q="1"/>',
    'the name of a macro': '<xacro:call macro="CALL"/>',
    'the name of an element': '<xacro:element xacro:name="CALL"/>',
    'a comment': '<!-- xacro:eval-comments --><!-- CALL -->',
}
# What leads out of the folder of the description.
OUTSIDE = {
    'include above': '<xacro:include filename="../SECRET.xml"/>',
    'optional include above': '<xacro:include filename="../SECRET.xml" optional="true"/>',
    'include by a link': '<xacro:include filename="link.xml"/>',
    'include by a linked folder': '<xacro:include filename="folder/SECRET.xml"/>',
    'include by a pattern': '<xacro:include filename="../*.xml"/>',
    'include by a pattern of links': '<xacro:include filename="l*.xml"/>',
    'include by a pattern with steps up': '<xacro:include filename="f[o]lder/SECRET.xml"/>',
    'include beside, not a package': '<xacro:include filename="$(find neighbour)/a.xml"/>',
    'YAML above': '<a b="${xacro.load_yaml(\'../SECRET.yaml\')}"/>',
    'YAML above, the old way': '<a b="${load_yaml(\'../SECRET.yaml\')}"/>',
    'YAML by a whole name': '<a b="${load_yaml(xacro.abs_filename(\'../SECRET.yaml\'))}"/>',
}
# Name: text, and words of the refusal.
DESCRIPTIONS = {
    **{
        f'shell in {place}': (robot(body.replace('CALL', CALL)), 'a lambda')
        for place, body in CALLED.items()
    },
    **{name: (robot(body), 'lies outside') for name, body in OUTSIDE.items()},
    'shell built by properties': (
        robot(
            f'<xacro:property name="a" value="{SHELL[:40]}"/>'
            f'<xacro:property name="b" value="{SHELL[40:]}"/>'
            '<xacro:property name="c" value="${a}${b}"/>'
            '<xacro:property name="d" value="$${${c}}"/>'
            '<link name="${d}"/><xacro:if value="${c}"/>'
        ),
        'which is not a boolean',
    ),
    'shell in a unit': (robot('<a b="${xacro.load_yaml(\'unit.yaml\')}"/>'), 'lambda'),
    '$(eval)': (robot(f'<a b="$(eval {SHELL[:-1]})"/>'), '$(eval'),
    '$(eval) with a lambda': (robot('<a b="$(eval (lambda: 0)()"/>'), '$(eval'),
    '$(env)': (robot('<a b="$(env HOME)"/>'), '$(env HOME): the environment is not read'),
    '$(optenv)': (robot('<a b="$(optenv HOME x)"/>'), 'the environment is not read'),
    'env in $(eval)': (robot('<a b="$(eval env(\'HOME\'))"/>'), '$(eval env'),
    '$(dirname)': (robot('<a b="$(dirname)"/>'), '$(dirname): no substitution'),
    '$(cwd)': (robot('<a b="$(cwd)"/>'), '$(cwd): no substitution'),
    '$(find) of a path': (robot('<a b="$(find ../../..)"/>'), 'it needs the ROS package ../../..'),
    '$(find) of the root': (robot('<a b="$(find /etc)"/>'), 'it needs the ROS package /etc'),
    'include of a whole path': (robot('<xacro:include filename="/etc/passwd"/>'), '/etc/passwd'),
    'include of a device': (robot('<xacro:include filename="pipe.xml"/>'), 'not a regular file'),
    'YAML with a tag': (robot('<a b="${xacro.load_yaml(\'tag.yaml\')}"/>'), 'no YAML'),
    'YAML that doubles': (robot('<a b="${xacro.load_yaml(\'laughs.yaml\')}"/>'), 'too long'),
    'YAML that holds itself': (robot('<a b="${xacro.load_yaml(\'self.yaml\')}"/>'), 'too'),
    'entities that double': (
        robot(
            '<a b="&e9;"/>',
            '<!DOCTYPE r [<!ENTITY e0 "aaaaaaaaaa">'
            + ''.join(f'<!ENTITY e{i + 1} "{f"&e{i};" * 10}">' for i in range(9))
            + ']>',
        ),
        'DOCTYPE',
    ),
    'an entity that is a file': (
        robot('<a>&e;</a>', '<!DOCTYPE r [<!ENTITY e SYSTEM "file:///etc/passwd">]>'),
        'DOCTYPE',
    ),
    'an included file with entities': (
        robot('<xacro:include filename="entities.xml"/>'),
        'entities.xml: it declares a DOCTYPE',
    ),
    'texts that double': (
        robot(
            '<xacro:property name="p0" value="aaaaaaaaaa"/>'
            + ''.join(
                f'<xacro:property name="p{i + 1}" value="{f"${{p{i}}}" * 10}"/>' for i in range(12)
            )
            + '<a b="${p12}"/>'
        ),
        'it expands to more than',
    ),
    'lists that double': (
        robot(
            '<xacro:property name="p0" value="${[1, 1]}"/>'
            + ''.join(
                f'<xacro:property name="p{i + 1}" value="${{[p{i}, p{i}]}}"/>' for i in range(40)
            )
            + '<a b="${p40}"/>'
        ),
        'too long',
    ),
    'a property of itself': (
        robot('<xacro:property name="p" value="${p + 1}"/><a b="${p}"/>'),
        'circular',
    ),
    'a macro of itself': (
        robot('<xacro:macro name="m"><xacro:m/></xacro:macro><xacro:m/>'),
        'nested too deeply',
    ),
    'a file of itself': (robot('<xacro:include filename="arm.urdf.xacro"/>'), 'nested too deeply'),
    'elements too deep': (robot('<a>' * 5000 + '</a>' * 5000), 'nested too deeply'),
    'a substitution of another program': (robot('<a b="$(command touch CANARY)"/>'), 'command'),
}


@pytest.fixture
def cell(tmp_path):
    """Return a folder for a description, with traps in it and around it."""
    folder = tmp_path / 'description'
    folder.mkdir()
    (tmp_path / 'SECRET.xml').write_text('<a secret="SECRET-TEXT"/>')
    (tmp_path / 'SECRET.yaml').write_text('a: SECRET-TEXT')
    (tmp_path / 'neighbour').mkdir()
    (tmp_path / 'neighbour' / 'a.xml').write_text('<a secret="SECRET-TEXT"/>')
    (folder / 'link.xml').symlink_to(tmp_path / 'SECRET.xml')
    (folder / 'folder').symlink_to(tmp_path)
    os.mkfifo(folder / 'pipe.xml')
    canary = tmp_path / 'canary'
    (folder / 'unit.yaml').write_text(f'a: !degrees "{SHELL.format(canary=canary)}"')
    (folder / 'tag.yaml').write_text(f'!!python/object/apply:os.system ["touch {canary}"]')
    (folder / 'self.yaml').write_text('&a [1, *a]')
    doubling = ''.join(
        f'{b}: &{b} [*{a}, *{a}]\n'
        for a, b in zip('abcdefghijklmnopqrstuv', 'bcdefghijklmnopqrstuvw')
    )
    (folder / 'laughs.yaml').write_text(f'a: &a [1, 1]\n{doubling}')
    (folder / 'entities.xml').write_text(
        '<!DOCTYPE r [<!ENTITY e SYSTEM "file:///etc/passwd">]><r>&e;</r>'
    )
    return folder


def files(folder):
    return sorted(str(path) for path in folder.rglob('*'))


@pytest.mark.parametrize('name', DESCRIPTIONS)
def test_a_hostile_description_is_refused_in_one_line_and_leaves_no_trace(name, cell, caplog):
    text, words = DESCRIPTIONS[name]
    path = cell / 'arm.urdf.xacro'
    canary = str(cell.parent / 'canary')
    path.write_text(text.replace('{canary}', canary).replace('CANARY', canary))
    before = files(cell.parent)
    with caplog.at_level(logging.DEBUG), pytest.raises(InputError) as refused:
        read_description(path)
    line = str(refused.value)
    assert words in line
    assert '.x' in line.partition(': ')[0] or '.yaml' in line.partition(': ')[0]
    assert len(line.splitlines()) == 1
    assert files(cell.parent) == before
    assert 'SECRET-TEXT' not in line + caplog.text


# A pattern of xacro's own takes exponential time for this default of a parameter.
BOMBS = {
    'macros that double': '<xacro:macro name="m0"><a/></xacro:macro>'
    + ''.join(
        f'<xacro:macro name="m{i + 1}"><xacro:m{i}/><xacro:m{i}/></xacro:macro>' for i in range(60)
    )
    + '<xacro:m60/>',
    'a default of many ways': f'<xacro:macro name="m" params="p:={"a" * 60}&quot;"/>',
}


@pytest.mark.parametrize('limit', ['CPU_S', 'WALL_S'])
@pytest.mark.parametrize('name', BOMBS)
def test_a_bomb_ends_by_either_limit(name, limit, cell, monkeypatch):
    """By processor time; and by wall time where a busy computer gives it little of that."""
    monkeypatch.setattr(robot_description, limit, 1)
    path = cell / 'arm.urdf.xacro'
    path.write_text(robot(BOMBS[name]))
    words = {'CPU_S': '1 s of processor time;', 'WALL_S': '1 s; if this computer is busy'}[limit]
    with pytest.raises(InputError, match=f'not expanded after {words}'):
        read_description(path)


def test_the_limits_are_half_a_minute():
    assert robot_description.CPU_S == robot_description.WALL_S == 30


def chain_of(joints, kind='revolute'):
    """Return a URDF of so many joints one behind the other."""
    parts = ''.join(
        f'<link name="l{i + 1}"/><joint name="j{i}" type="{kind}"><parent link="l{i}"/>'
        f'<child link="l{i + 1}"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
        for i in range(joints)
    )
    return f'<robot name="r"><link name="l0"/>{parts}</robot>'


@pytest.mark.parametrize('kind', ['revolute', 'fixed', 'prismatic'])
@pytest.mark.parametrize(('joints', 'words'), [(300, 'links between'), (60_000, '60001 links')])
def test_a_description_of_more_links_than_any_robot_has_is_refused(joints, words, kind, tmp_path):
    (tmp_path / 'arm.urdf').write_text(chain_of(joints, kind))
    with pytest.raises(InputError, match=words):
        read_arm(tmp_path / 'arm.urdf')


@pytest.mark.parametrize('name', ['arm.urdf', 'arm.xml', 'arm'])
def test_only_a_file_that_is_named_xacro_is_expanded(name, cell):
    text = robot(f'<link name="${{(lambda: {SHELL})()}}"/><xacro:include filename="link.xml"/>')
    (cell / name).write_text(text)
    assert read_description(cell / name) == text


def test_trust_allows_what_a_program_may_and_nothing_else_does(cell, monkeypatch):
    monkeypatch.setenv('ARM_NAME', 'mine')
    path = cell / 'arm.urdf.xacro'
    path.write_text(
        robot('<a b="$(env ARM_NAME)" c="${[2 * i for i in [1]][0]}"/>').replace(
            '</robot>', '<xacro:include filename="../SECRET.xml"/></robot>'
        )
    )
    with pytest.raises(InputError, match='add --trust if you trust this file'):
        read_description(path)
    text = read_description(path, trusted=True)
    assert '<a b="mine" c="2"/>' in text
    assert 'SECRET-TEXT' not in text.split('<a b=')[0]


def test_modules_beside_the_description_are_not_imported(cell, monkeypatch):
    for module in ('yaml', 'xacro', 'json'):
        (cell / f'{module}.py').write_text(f'open({str(cell / "canary")!r}, "w")')
    (cell / 'arm.xacro').write_text(robot('<a b="${1 + 1}"/>'))
    monkeypatch.chdir(cell)
    assert '<a b="2"/>' in read_description(Path('arm.xacro'))
    assert not (cell / 'canary').exists()


def test_files_of_the_description_its_package_and_named_packages_are_read(tmp_path, monkeypatch):
    for package in ('arm', 'tool'):
        (tmp_path / package / 'config').mkdir(parents=True)
        (tmp_path / package / 'package.xml').write_text(
            f'<package><name>{package}</name></package>'
        )
        (tmp_path / package / 'config' / 'a.yaml').write_text(
            f'length: !millimeters 250\nof: {package}'
        )
        (tmp_path / package / 'part.xacro').write_text('<r><part/></r>')
    (tmp_path / 'arm' / 'urdf').mkdir()
    path = tmp_path / 'arm' / 'urdf' / 'arm.xacro'
    path.write_text(
        robot(
            '<xacro:include filename="../part.xacro"/>'
            '<xacro:include filename="$(find tool)/p*.xacro"/>'
            '<xacro:include filename="$(find tool)/none.xacro" optional="true"/>'
            '<xacro:property name="own" value="${xacro.load_yaml(\'../config/a.yaml\')}"/>'
            '<a b="${own.length}" c="${load_yaml(\'$(find tool)/config/a.yaml\')[\'of\']}"/>'
        )
    )
    text = read_description(path)
    assert text.count('<part/>') == 2
    assert '<a b="0.25" c="tool"/>' in text
    # As colcon build --symlink-install leaves them: links from a sourced workspace to the sources.
    share = tmp_path / 'install' / 'share' / 'other'
    share.mkdir(parents=True)
    (tmp_path / 'elsewhere').mkdir()
    (tmp_path / 'elsewhere' / 'part.xacro').write_text('<r><linked/></r>')
    (share / 'part.xacro').symlink_to(tmp_path / 'elsewhere' / 'part.xacro')
    path.write_text(robot('<xacro:include filename="$(find other)/part.xacro"/>'))
    with pytest.raises(InputError, match='it needs the ROS package other'):
        read_description(path)
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path / 'install'))
    assert '<linked/>' in read_description(path)


@pytest.mark.parametrize('is_absolute', [False, True])
def test_a_file_that_the_user_names_is_read_wherever_it_lies(is_absolute, cell, monkeypatch):
    """As of a UR, whose calibration lies with the robot and not with its description."""
    elsewhere = cell.parent / 'robots'
    elsewhere.mkdir()
    (elsewhere / 'arm7.yaml').write_text('length: 0.425')
    (elsewhere / 'other.yaml').write_text('length: 1.0')
    path = cell / 'arm.xacro'
    default = '<xacro:arg name="file" default="../robots/arm7.yaml"/>'
    path.write_text(
        robot(
            f'{default}<a b="${{xacro.load_yaml(\'$(arg file)\').length}}"/>'
            '<xacro:arg name="more" default=""/><xacro:if value="${\'$(arg more)\' != \'\'}">'
            '<a c="${xacro.load_yaml(\'../robots/other.yaml\').length}"/></xacro:if>'
        )
    )
    # What the description names by itself stays outside.
    with pytest.raises(InputError, match='lies outside'):
        read_description(path)
    monkeypatch.chdir(elsewhere)
    named = {'file': str(elsewhere / 'arm7.yaml') if is_absolute else 'arm7.yaml'}
    assert '<a b="0.425"/>' in read_description(path, named)
    with pytest.raises(InputError, match=r'other.yaml, which lies outside'):
        read_description(path, {**named, 'more': 'arm7.yaml'})


MESHES = {
    'a whole path': 'file://{outside}/part.stl',
    'steps up': '../outside/part.stl',
    'steps up in a package': 'package://description/../outside/part.stl',
    'steps up as a package': 'package://../outside/part.stl',
    'a link': 'link.stl',
    'a link in a package': 'package://description/link.stl',
    'hidden steps': 'package://description/%2e%2e/outside/part.stl',
}


@pytest.mark.parametrize('name', MESHES)
def test_meshes_outside_of_the_description_and_of_packages_are_not_read(name, cell):
    outside = cell.parent / 'outside'
    outside.mkdir()
    (outside / 'part.stl').write_text('solid')
    (cell / 'link.stl').symlink_to(outside / 'part.stl')
    with pytest.raises(InputError, match=r'outside of|no mesh'):
        find_mesh(MESHES[name].format(outside=outside), cell / 'arm.urdf', [])
    assert find_mesh('part.stl', cell / 'arm.urdf', [outside]) == outside / 'part.stl'


@pytest.mark.parametrize(
    'content',
    [
        b'<!DOCTYPE c [<!ENTITY e SYSTEM "file:///etc/passwd">]><COLLADA>&e;</COLLADA>',
        '<!DOCTYPE c [<!ENTITY e "x">]><COLLADA/>'.encode('utf-16'),
        b'<?xml version="1.0" encoding="UTF-7"?>+ADwAIQ-DOCTYPE c><COLLADA/>',
        b'PK\x03\x04 an archive',
    ],
)
def test_a_collada_file_with_entities_or_in_an_archive_is_refused(content, tmp_path):
    (tmp_path / 'part.dae').write_bytes(content)
    with pytest.raises(InputError, match=r'part.dae: .*(no plain COLLADA file|UTF-16)'):
        read_mesh(tmp_path / 'part.dae')
