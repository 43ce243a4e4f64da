"""Open a page in headless Chromium, do something in it, and return what was seen."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

NAMES = ('chromium', 'chromium-browser', 'google-chrome')
WEBGL = ('--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader')
NO_WEBGL = ('--disable-3d-apis',)
FOUND = '<pre id="found-by-the-test">'


def seen(page: Path, script: str, *flags: str, seconds: float = 4.0) -> Any:
    """Return what an asynchronous script returns that runs in a copy of the page once it is open.

    The test is skipped where there is no Chromium. The page has no network.
    """
    browser = next(filter(None, map(shutil.which, NAMES)), None)
    if browser is None:
        pytest.skip(f'no browser: none of {", ".join(NAMES)} is installed')
    html = page.read_text(encoding='utf-8')
    end = html.rindex('</body>')
    probe = f"""<script>addEventListener('load', async () => {{
        const errors = [];
        addEventListener('error', (event) => errors.push(event.message));
        const wait = (ms) => new Promise((done) => setTimeout(done, ms));
        await wait(500);
        let found;
        try {{
            found = await (async () => {{ {script} }})();
        }} catch (error) {{ errors.push(`${{error}}`); }}
        const pre = document.createElement('pre');
        pre.id = 'found-by-the-test';
        pre.textContent = JSON.stringify({{found, errors}}).replace(/</g, '\\\\u003c');
        document.body.append(pre);
    }})</script>"""
    copy = page.with_name(f'{page.stem}_probed.html')
    copy.write_text(html[:end] + probe + html[end:], encoding='utf-8')
    command = [
        browser,
        '--headless',
        '--no-sandbox',
        '--disable-gpu-sandbox',
        '--host-resolver-rules=MAP * ~NOTFOUND',
        f'--user-data-dir={page.parent / "browser"}',
        f'--virtual-time-budget={int(1000 * seconds)}',
        *flags,
        '--dump-dom',
        copy.as_uri(),
    ]
    process = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert FOUND in process.stdout, process.stderr[-2000:]
    text = process.stdout.rpartition(FOUND)[2].partition('</pre>')[0]
    answer = json.loads(text.replace('&lt;', '<').replace('&gt;', '>').replace('&amp;', '&'))
    assert answer['errors'] == []
    return answer['found']
