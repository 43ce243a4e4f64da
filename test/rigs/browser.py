# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium, driven over its DevTools protocol: what a person does with a page."""

import asyncio
import base64
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path

import pytest
from tornado.websocket import websocket_connect

NAMES = ('chromium', 'chromium-browser', 'google-chrome')
WEBGL = ('--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader')
NO_WEBGL = ('--disable-3d-apis',)


class Browser:
    """One tab. Errors of the page's scripts are collected in `errors`.

    Without ``webgl`` a page that is drawn all the time costs a third less.
    """

    def __init__(self, profile, *flags, webgl=True):
        program = next(filter(None, map(shutil.which, NAMES)), None)
        if program is None:
            pytest.skip(f'needs a browser: one of {", ".join(NAMES)} on PATH')
        self._process = subprocess.Popen(
            [
                program,
                *('--headless', '--no-sandbox', '--no-first-run', '--disable-extensions'),
                *('--remote-debugging-port=0', *(WEBGL if webgl else ('--disable-gpu',))),
                *(f'--user-data-dir={profile}', '--window-size=1200,1500', *flags, 'about:blank'),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self._loop = asyncio.new_event_loop()
        self._number, self.errors, self.requests = 0, [], []
        try:
            self._connect(profile / 'DevToolsActivePort')
        except BaseException:
            self._loop.close()
            self._process.kill()
            self._process.wait()
            raise

    def _connect(self, port_file):
        deadline = time.monotonic() + 60.0
        while not (port_file.exists() and port_file.read_text().count('\n')):
            assert time.monotonic() < deadline, 'the browser does not start'
            time.sleep(0.05)
        port = port_file.read_text().split('\n')[0]
        while not (pages := [p for p in self._listed(port) if p['type'] == 'page']):
            assert time.monotonic() < deadline, 'the browser opens no tab'
        self._socket = self._loop.run_until_complete(
            self._connected(pages[0]['webSocketDebuggerUrl'])
        )
        for domain in ('Page', 'Runtime', 'Network', 'Log'):
            self.send(f'{domain}.enable')

    @staticmethod
    async def _connected(url):
        return await websocket_connect(url, max_message_size=100_000_000)

    @staticmethod
    def _listed(port):
        with urllib.request.urlopen(f'http://127.0.0.1:{port}/json', timeout=30) as answer:
            return json.load(answer)

    def send(self, method, **parameters):
        """Send a command of the protocol and return its result."""
        self._number += 1
        content = {'id': self._number, 'method': method, 'params': parameters}
        return self._loop.run_until_complete(self._exchange(content))

    async def _exchange(self, content):
        await self._socket.write_message(json.dumps(content))
        while True:
            text = await asyncio.wait_for(self._socket.read_message(), 60.0)
            answer = json.loads(text)
            if answer.get('id') == content['id']:
                assert 'error' not in answer, answer
                return answer['result']
            self._take(answer)

    def _take(self, event):
        match event.get('method'), event.get('params'):
            case 'Runtime.exceptionThrown', parameters:
                self.errors.append(parameters['exceptionDetails'])
            case 'Log.entryAdded', {'entry': {'level': 'error', 'source': source} as entry}:
                # A refused or cut connection is what some tests want.
                if source != 'network':
                    self.errors.append(entry)
            case 'Network.requestWillBeSent', {'request': request}:
                self.requests.append(request)

    def open(self, url):
        """Go to an address, as a person who types it."""
        # Another fragment alone does not load a page again.
        self.send('Page.navigate', url='about:blank')
        self.send('Page.navigate', url=url)

    def reload(self):
        """Load the page again."""
        self.send('Page.reload')

    def value(self, expression):
        """Return the value of a JavaScript expression."""
        answer = self.send(
            'Runtime.evaluate', expression=expression, returnByValue=True, awaitPromise=True
        )
        assert 'exceptionDetails' not in answer, answer
        return answer['result'].get('value')

    def text(self, selector):
        """Return what of an element is seen; '' where it is hidden."""
        return self.value(
            f'(() => {{ const e = document.querySelector({json.dumps(selector)});'
            ' return e && e.checkVisibility() ? e.innerText : ""; })()'
        )

    def click(self, selector):
        """Click in the middle of an element, with the mouse."""
        place = self.value(
            f'(() => {{ const e = document.querySelector({json.dumps(selector)});'
            ' e.scrollIntoView({block: "center"});'
            ' const r = e.getBoundingClientRect();'
            ' return [r.x + r.width / 2, r.y + r.height / 2]; })()'
        )
        x, y = place
        for kind in ('mousePressed', 'mouseReleased'):
            self.send('Input.dispatchMouseEvent', type=kind, x=x, y=y, button='left', clickCount=1)

    def look_elsewhere(self, link):
        """Click a link that opens a tab of its own, and come back to this one.

        A tab that is not in front draws nothing, and its timers come once a second.
        """
        self.click(link)
        self.send('Page.bringToFront')

    def network(self, *, connected):
        """Cut the network of the page, or connect it again."""
        self.send(
            'Network.emulateNetworkConditions',
            offline=not connected,
            latency=0,
            downloadThroughput=-1,
            uploadThroughput=-1,
        )

    def until(self, condition, what, timeout_s=30.0):
        """Wait until `condition()` holds."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, (what, self.text('body'), self.errors)
            time.sleep(0.1)

    def picture(self, path):
        """Write a PNG of the whole page."""
        answer = self.send('Page.captureScreenshot', captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(answer['data']))

    def close(self):
        """End the browser."""
        self._socket.close()
        self._loop.run_until_complete(asyncio.sleep(0.05))
        self._loop.close()
        self._process.terminate()
        self._process.wait(20)


def seen(page, script, *flags):
    """Return what an asynchronous script returns in a page that was opened without a network.

    It runs once the page says that it is no longer loading. The test is skipped where there is no
    Chromium.
    """
    profile = Path(tempfile.mkdtemp(dir=page.parent))
    tab = Browser(profile, '--host-resolver-rules=MAP * ~NOTFOUND', *flags)
    try:
        tab.open(page.as_uri())
        loaded = f'document.readyState == "complete" && location.href == {page.as_uri()!r}'
        tab.until(lambda: tab.value(loaded), 'the page')
        played = 'document.getElementById("loading").hidden'
        tab.until(lambda: tab.value(played), 'what the page shows', timeout_s=120.0)
        wait = 'const wait = (ms) => new Promise((done) => setTimeout(done, ms));'
        found = tab.value(f'(async () => {{ {wait} {script} }})()')
        assert tab.errors == []
        return found
    finally:
        tab.close()
