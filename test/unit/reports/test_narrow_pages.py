# SPDX-License-Identifier: Apache-2.0
"""On a telephone the zero-offsets of a fit's page are read without scrolling sideways."""

import pytest
from rigs.browser import Browser

from remaster_ros.reports.fit_page import fit_html

WIDTH = 390


@pytest.mark.parametrize('scheme', ['light', 'dark'])
def test_the_table_of_offsets_fits_a_narrow_page(scheme, fit_result, tmp_path):
    page = tmp_path / 'report.html'
    page.write_text(fit_html(fit_result, {}), encoding='utf-8')
    tab = Browser(tmp_path / 'profile', '--host-resolver-rules=MAP * ~NOTFOUND')
    try:
        tab.send(
            'Emulation.setDeviceMetricsOverride',
            width=WIDTH, height=800, deviceScaleFactor=1, mobile=True,
        )  # fmt: skip
        features = [{'name': 'prefers-color-scheme', 'value': scheme}]
        tab.send('Emulation.setEmulatedMedia', features=features)
        tab.open(page.as_uri())
        loaded = f'document.readyState == "complete" && location.href == {page.as_uri()!r}'
        tab.until(lambda: tab.value(loaded), 'the page')
        assert tab.value('document.documentElement.scrollWidth') <= WIDTH
        inner, outer = tab.value(
            '(() => { const box = document.querySelector(".offsets").parentElement;'
            ' return [box.scrollWidth, box.clientWidth]; })()'
        )
        assert inner <= outer
        assert 'std if the arm is exactly its drawing: ' in tab.value(
            'getComputedStyle(document.querySelector("td.drawn:not(.none)"), "::before").content'
        )
        assert tab.errors == []
    finally:
        tab.close()
