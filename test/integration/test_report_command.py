# SPDX-License-Identifier: Apache-2.0
"""`remaster report` as a user runs it: simulate, fit, discover, and one page with its figures."""

from __future__ import annotations

import csv
import hashlib
import json
import re
import shutil
import zlib
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from rigs.command_line import refusal, remaster

# Seconds since 1970 of the first reading: 08:43:20 UTC on 22 November 2026.
START_S = 1795337000.0
SEED = 3


class Text(HTMLParser):
    """Collects what a reader sees, and the addresses that a page refers to."""

    def __init__(self) -> None:
        super().__init__()
        self.hidden, self.words, self.addresses = 0, [], []

    def handle_starttag(self, tag, attrs):
        self.hidden += tag in ('style', 'script')
        self.addresses += [value for key, value in attrs if key in ('href', 'src', 'xlink:href')]

    def handle_endtag(self, tag):
        self.hidden -= tag in ('style', 'script')

    def handle_data(self, data):
        if not self.hidden:
            self.words += data.split()


@pytest.fixture(scope='module')
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session whose camera bar was bumped, its fit, its discovery, page and PDF."""
    folder = tmp_path_factory.mktemp('made')
    session = folder / 'session'
    print('seed', SEED)
    options = ('--poses', 26, '--validation', 8, '--sensors', 'mocap', '--seed', SEED)
    bump = ('--effect', 'bumped_sensor:1')
    remaster('simulate', session, *options, *bump, '--quiet')
    with_clock(session)
    remaster('fit', session, '--out', folder / 'fit', '--quiet')
    remaster('discover', session, '--out', folder / 'found', '--quiet')
    pdf = ('--pdf',) if find_spec('weasyprint') else ()
    done = remaster(
        *('report', session, folder / 'found', folder / 'fit'),
        *('--out', folder / 'report', '--json', *pdf),
    )
    assert done.stderr == ''
    (folder / 'answer.json').write_text(done.stdout)
    return folder


def with_clock(session: Path) -> None:
    """Give a session times counted from 1970, and say who measured which arm."""
    path = session / 'observations.csv'
    rows = list(csv.reader(path.read_text().splitlines()))
    stamp = rows[0].index('stamp_s')
    for row in rows[1:]:
        row[stamp] = repr(float(row[stamp]) + START_S)
    with path.open('w') as file:
        csv.writer(file, lineterminator='\n').writerows(rows)
    header = session / 'session.yaml'
    text = header.read_text()
    header.write_text(
        text[: text.index('notes:')]
        + "operator: A. Muster\nserial_number: LWR4-0815\nnotes: 'after <b>the collision</b>'\n"
    )


@pytest.fixture(scope='module')
def page(made: Path) -> Text:
    page = Text()
    page.feed((made / 'report/report.html').read_text(encoding='utf-8'))
    page.close()
    return page


def test_the_page_has_the_answer_first(made: Path, page: Text) -> None:
    answer = json.loads((made / 'answer.json').read_text())
    assert (answer['mood'], answer['action']) == ('caution', 'set')
    text = ' '.join(page.words)
    assert text.index('LWR4-0815: what to do') < text.index(answer['headline'])
    html = (made / 'report/report.html').read_text(encoding='utf-8')
    order = ['do', 'brings', 'remains', 'causes', 'poses', 'sure', 'appendix', 'identity']
    places = [html.index(f'id="{name}"') for name in order]
    assert places == sorted(places)
    # The angles are minus the offsets of the files that the page links to.
    for row in json.loads((made / 'found/discovery.json').read_text())['joint_offsets_after']:
        if row['identifiable']:
            angle = f'{-row["mean_deg"]:+.4f}'.replace('-', '−')
            assert f'{row["joint"]} {angle}' in text
    for address in page.addresses:
        inside = address.startswith(('#', 'data:image/png;base64,'))
        assert inside or (made / 'report' / address).is_file(), address
    for part in ('A. Muster', 'after <b>the collision</b>', 'remaster_ros 0.'):
        assert part in text
    digest = hashlib.sha256((made / 'session/observations.csv').read_bytes()).hexdigest()
    assert digest in text


def test_a_bump_is_told_in_words_by_the_clock(made: Path, page: Text) -> None:
    truth = json.loads((made / 'session/truth.json').read_text())['effects'][0]['detail']
    text = ' '.join(page.words)
    sensor = truth['sensor']
    assert f'The sensor {sensor} moved' in text
    sentence = re.search(
        r'jumped at 08:(\d\d):(\d\d) UTC on 2026-11-22, .* between configurations (\d+) and (\d+)',
        text,
    )
    assert sentence is not None
    clock_s = 60 * (int(sentence[1]) - 43) + int(sentence[2]) - 20
    rows = list(csv.DictReader((made / 'session/observations.csv').read_text().splitlines()))
    elapsed = np.array([float(row['stamp_s']) for row in rows])
    found_s = clock_s - (elapsed[0] - START_S)
    elapsed -= elapsed[0]
    # Readings beside the jump are none of the gross errors: they tell when it was.
    before = elapsed < truth['moment_s']
    configuration = np.array([int(row['configuration']) for row in rows])
    assert int(sentence[3]) == configuration[before].max()
    assert int(sentence[4]) == configuration[~before].min()
    assert elapsed[before].max() <= found_s <= elapsed[~before].min()
    assert 'left out as gross errors' not in text
    assert re.search(rf'{sensor} by \d\.\d+ mm ± 0\.\d+ mm along \([^)]*\) in its own frame', text)
    for page_file in (made / 'found/report.html', made / 'report/report.html'):
        html = page_file.read_text(encoding='utf-8')
        assert 'unnamed' not in re.sub(r'id="[^"]*"', '', html)
        assert 'change point of one level' in html


def test_the_numbers_of_the_page_agree_with_the_files(made: Path, page: Text) -> None:
    answer = json.loads((made / 'answer.json').read_text())
    rows = list(csv.DictReader((made / 'fit/residuals.csv').read_text().splitlines()))
    held_out = [row for row in rows if row['split'] == 'validation']
    lengths = {
        side: np.array([[float(row[f'{side}_{axis}_m']) for axis in 'xyz'] for row in held_out])
        for side in ('before', 'after')
    }
    fit = json.loads((made / 'fit/fit.json').read_text())
    metric = fit['accuracy']['validation']['post_registration']
    for stage, side in zip(answer['stages'], ('before', 'after'), strict=False):
        errors = 1e3 * np.linalg.norm(lengths[side], axis=1)
        assert stage['mean_mm'] == pytest.approx(metric[side]['mean_mm'], abs=1e-4)
        assert stage['most_mm'] == pytest.approx(np.quantile(errors, 0.95), abs=1e-9)
        assert stage['largest_mm'] == pytest.approx(errors.max(), abs=1e-9)
    found = json.loads((made / 'found/discovery.json').read_text())
    after = found['metrics']['post_registration']['after']['mean_mm']
    assert answer['stages'][2]['mean_mm'] == pytest.approx(after, abs=1e-4)
    text = ' '.join(page.words)
    for stage in answer['stages']:
        row = ' '.join(f'{stage[key]:.3f}' for key in ('mean_mm', 'most_mm', 'largest_mm'))
        assert f'{stage["title"]} {row}' in text
    # The figures of the discovery have the means that its table has.
    assert f'after: mean {after:.3f} mm' in (made / 'found/figures/gain.svg').read_text()
    assert '103.9' not in (made / 'found/report.html').read_text(encoding='utf-8')


def test_the_pdf_is_a_few_pages(made: Path) -> None:
    pytest.importorskip('weasyprint', reason="needs pip install 'remaster_ros[pdf]'")
    data = (made / 'report/report.pdf').read_bytes()
    assert data.startswith(b'%PDF')
    # Most objects stand in compressed streams.
    unpacked_data = b''.join(
        zlib.decompressobj().decompress(stream.lstrip(b'\r\n'))
        for stream in re.findall(rb'/FlateDecode.*?stream(.*?)endstream', data, re.DOTALL)
    )
    assert 2 <= len(re.findall(rb'/Type /Page\b', data + unpacked_data)) <= 7


def test_results_of_other_data_are_refused_in_one_line(made: Path, tmp_path: Path) -> None:
    session = tmp_path / 'session'
    shutil.copytree(made / 'session', session)
    path = session / 'observations.csv'
    path.write_text('\n'.join(path.read_text().splitlines()[:-1]) + '\n')
    line = refusal('report', session, made / 'fit', '--out', tmp_path / 'out')
    assert 'of other data than this session' in line


def test_a_session_alone_is_fitted_first(made: Path, tmp_path: Path) -> None:
    done = remaster('report', made / 'session', '--out', tmp_path / 'out', '--no-figures')
    assert (tmp_path / 'out/fit/fit.json').is_file()
    assert 'remaster discover' in done.stdout
    html = (tmp_path / 'out/report.html').read_text(encoding='utf-8')
    assert '<svg' not in html
    assert 'More than noise' in html


def test_a_session_in_which_something_moved_is_green_on_no_page(made: Path) -> None:
    for page in ('fit/report.html', 'found/report.html', 'report/report.html'):
        html = (made / page).read_text(encoding='utf-8')
        assert re.findall(r'class="verdict (\w+)"', html) == ['caution'], page
