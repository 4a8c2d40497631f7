"""A headless Chromium, controlled over a pipe with the DevTools protocol.

As a program, this module saves the first picture of the README from the address of a view::

    scripts/record run.mcap       # of scripts/run network
    scripts/view run.mcap --track --cycles 38
    python test/headless_browser.py ADDRESS docs/view.png

The colours of the file in the repository are reduced to 256.
"""

import base64
import contextlib
import itertools
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

_NAMES = ('chromium', 'chromium-browser', 'google-chrome')
_OPTIONS = (
    '--headless', '--no-sandbox', '--remote-debugging-pipe', '--hide-scrollbars', '--no-first-run',
    '--disable-background-networking', '--disable-component-update', '--disable-sync',
    # Chromium draws WebGL without a graphics card only on request.
    '--use-angle=swiftshader', '--enable-unsafe-swiftshader')
# Chromium reads commands from this file descriptor and writes to the next one.
_FIRST_DESCRIPTOR = 3
_TIMEOUT_S = 60.0
_DRAWING_S = 20.0


def executable():
    """Path of an installed browser; None if there is none."""
    return next(filter(None, map(shutil.which, _NAMES)), None)


class Browser:
    """A context manager with one page; its width and height are in pixels at scale 1."""

    def __init__(self, width=1600, height=1000, scale=1.0):
        self._stack = contextlib.ExitStack()
        folder = self._stack.enter_context(
            tempfile.TemporaryDirectory(prefix='browser-', ignore_cleanup_errors=True))
        commands, self._commands = os.pipe()
        self._results, results = os.pipe()
        # A shell moves the pipes, because Python code must not run between fork and exec.
        line = f'exec "$@" {_FIRST_DESCRIPTOR}<&{commands} {_FIRST_DESCRIPTOR + 1}>&{results}'
        with open(Path(folder) / 'log', 'wb') as log:
            self._process = subprocess.Popen(
                ['bash', '-c', line, 'bash', executable(), *_OPTIONS,
                 f'--user-data-dir={folder}', f'--window-size={width},{height}', 'about:blank'],
                pass_fds=(commands, results), stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        os.close(commands)
        os.close(results)
        self._numbers, self._received, self._session = itertools.count(1), b'', {}
        self._size = {'width': width, 'height': height, 'deviceScaleFactor': scale}

    def __enter__(self):
        try:
            page = next(target for target in self.call('Target.getTargets')['targetInfos']
                        if target['type'] == 'page')
            found = self.call('Target.attachToTarget', targetId=page['targetId'], flatten=True)
        except BaseException:
            self.__exit__()
            raise
        self._session = {'sessionId': found['sessionId']}
        self.call('Emulation.setDeviceMetricsOverride', mobile=False, **self._size)
        return self

    def __exit__(self, *details):
        self._process.terminate()
        try:
            self._process.wait(_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._commands)
        os.close(self._results)
        self._stack.close()

    def call(self, method, **parameters):
        """Return the result of a command."""
        number = next(self._numbers)
        command = {'id': number, 'method': method, 'params': parameters, **self._session}
        os.write(self._commands, json.dumps(command).encode() + b'\0')
        while (message := self._next()).get('id') != number:
            pass
        assert 'error' not in message, message['error']
        return message['result']

    def open(self, address):
        """Load a page, and wait until it is loaded."""
        self.call('Page.enable')
        error = self.call('Page.navigate', url=address).get('errorText')
        assert not error, f'{address}: {error}'
        while self._next().get('method') != 'Page.loadEventFired':
            pass

    def picture(self, top=0):
        """Return a picture of the page as PNG, without `top` pixels at its upper edge."""
        clip = {'x': 0, 'y': top, 'width': self._size['width'],
                'height': self._size['height'] - top, 'scale': 1}
        return base64.b64decode(
            self.call('Page.captureScreenshot', format='png', clip=clip)['data'])

    def scroll(self, x, y, distance):
        """Turn the mouse wheel at a point of the page; negative distances zoom in."""
        self.call('Input.dispatchMouseEvent', type='mouseWheel', x=x, y=y, deltaX=0,
                  deltaY=distance)

    def drag(self, x, y, right, down):
        """Drag with the left button from a point of the page, by a distance in pixels."""
        common = {'button': 'left', 'buttons': 1, 'clickCount': 1}
        self.call('Input.dispatchMouseEvent', type='mouseMoved', x=x, y=y)
        self.call('Input.dispatchMouseEvent', type='mousePressed', x=x, y=y, **common)
        self.call('Input.dispatchMouseEvent', type='mouseMoved', x=x + right, y=y + down, **common)
        self.call('Input.dispatchMouseEvent', type='mouseReleased', x=x + right, y=y + down,
                  **common)

    def _next(self):
        while b'\0' not in self._received:
            ready, _, _ = select.select([self._results], [], [], _TIMEOUT_S)
            assert ready, f'the browser does not answer within {_TIMEOUT_S:g} s'
            data = os.read(self._results, 1 << 20)
            assert data, f'the browser has ended with {self._process.wait()}'
            self._received += data
        message, _, self._received = self._received.partition(b'\0')
        return json.loads(message)


def main(address, file):
    """Save a picture of a view, without the menu of the viewer."""
    with Browser(1400, 960, scale=1.25) as browser:
        browser.open(address)
        # The page does not report when it has drawn the data.
        time.sleep(_DRAWING_S)
        browser.drag(300, 300, -70, 60)
        # The viewer describes what is under the mouse, so move it to the menu, which is cut off.
        browser.call('Input.dispatchMouseEvent', type='mouseMoved', x=500, y=10)
        time.sleep(_DRAWING_S)
        Path(file).write_bytes(browser.picture(top=34))


if __name__ == '__main__':
    main(*sys.argv[1:])
