"""1,000 frames a second with 50 markers each, received while other processes take the processor.

A process of its own sends the frames on schedule (late ones at once after it), as a camera
computer does; the client decodes every frame, finds its marker and hands the reading on; and busy
processes, two for each core, compete for the processor with both. Lost is every frame that was
sent and not seen. `--buffer` shows what smaller socket buffers would do: Linux allows 212992 bytes
unless net.core.rmem_max says otherwise.

Run: python benchmarks/bench_1khz.py [--seconds 60] [--load 4] [--buffer 2097152]
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import select
import socket
import struct
import time
from multiprocessing.connection import Connection

from bench_decode import scene

from remaster_ros.sensors.optitrack import sockets as natnet_sockets
from remaster_ros.sensors.optitrack.client import NatNetClient
from remaster_ros.sensors.optitrack.frame_gate import MarkerChoice, MarkerSample
from remaster_ros.sensors.optitrack.protocol import natnet
from remaster_ros.sensors.optitrack.settings import NatNetSettings

VERSION = (3, 1)
RATE_HZ = 1000
MARKER = 1 << 16 | 1
_TIMESTAMP_FROM_END = 38
"""Where the f64 time of a 3.x frame stands: 46 bytes of suffix, 8 of them time code before it."""


def serve(pipe: Connection, frames: int) -> None:
    """Answer CONNECT, then send the frames; tell the port first and the latest delay last."""
    info = natnet.ServerInfo(
        'bench', (3, 0, 0, 0), VERSION, natnet.Connection(10_000_000, 1511, False, '0.0.0.0')
    )
    welcome = natnet.encode_message(info, VERSION)
    frame = bytearray(natnet.encode_message(scene(VERSION), VERSION))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(('127.0.0.1', 0))
        pipe.send(server.getsockname()[1])
        _request, client = server.recvfrom(65536)
        server.sendto(welcome, client)
        pipe.recv()  # the client knows us
        begin, latest = time.monotonic() + 0.1, 0.0
        for number in range(1, frames + 1):
            due = begin + number / RATE_HZ
            while (early := due - time.monotonic()) > 0:
                if select.select([server], [], [], early)[0]:
                    server.recvfrom(65536)  # keep-alives
            latest = max(latest, -early)
            struct.pack_into('<i', frame, 4, number)
            struct.pack_into('<d', frame, len(frame) - _TIMESTAMP_FROM_END, number / RATE_HZ)
            server.sendto(frame, client)
        pipe.send(latest)
        pipe.recv()


def burn() -> None:
    """Keep a core busy."""
    while True:
        sum(range(10_000))


def kernel_drops(port: int) -> int:
    """Return how many datagrams Linux dropped because the buffer of a port's socket was full."""
    with open('/proc/net/udp') as table:
        rows = [line.split() for line in table][1:]
    return sum(int(row[-1]) for row in rows if int(row[1].split(':')[1], 16) == port)


def main() -> None:
    """Run it once; print what arrived."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seconds', type=int, default=60)
    parser.add_argument('--load', type=int, default=2 * (os.cpu_count() or 1))
    parser.add_argument('--buffer', type=int, default=natnet_sockets.RECEIVE_BUFFER_BYTES)
    args = parser.parse_args()
    natnet_sockets.RECEIVE_BUFFER_BYTES = args.buffer
    frames = args.seconds * RATE_HZ
    # Spawned: a forked child would share this process's lock on the interpreter's caches.
    context = multiprocessing.get_context('spawn')
    pipe, theirs = context.Pipe()
    server = context.Process(target=serve, args=(theirs, frames), daemon=True)
    burners = [context.Process(target=burn, daemon=True) for _ in range(args.load)]
    server.start()
    client_settings = NatNetSettings(
        command_port=pipe.recv(), transport='unicast', marker=MarkerChoice(marker_id=MARKER)
    )
    samples = 0

    def count(sample: MarkerSample) -> None:
        nonlocal samples
        samples += 1

    client = NatNetClient(client_settings, count)
    client.start()
    while client.status().server is None:
        time.sleep(0.01)
    assert client._command is not None
    port = client._command.getsockname()[1]
    granted = client._command.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    for burner in burners:
        burner.start()
    begin, used = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF)
    pipe.send('go')
    while not pipe.poll(5.0):
        status = client.status()
        print(f'{time.monotonic() - begin:5.0f} s: {status.frames} frames, lost {status.lost}, '
              f'load {os.getloadavg()[0]:.1f}', flush=True)  # fmt: skip
    latest = pipe.recv()
    deadline = time.monotonic() + 60.0
    drained = time.monotonic()
    while client.status().frames < frames and time.monotonic() < deadline:
        time.sleep(0.05)
    behind_s = time.monotonic() - drained
    status, drops = client.status(), kernel_drops(port)
    now = resource.getrusage(resource.RUSAGE_SELF)
    pipe.send('done')
    client.stop()
    for process in (server, *burners):
        process.kill()
        process.join()
    seconds = now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime
    print(
        f'{frames} frames sent in {args.seconds} s, {status.frames} received, '
        f'{frames - status.frames} lost ({drops} in the socket buffer of {granted} bytes), '
        f'{samples} readings, the last one {behind_s:.1f} s behind; '
        f'{seconds / frames * 1e6:.0f} µs of processor time a frame; '
        f'the sender was late by {latest * 1e3:.0f} ms at most; {args.load} busy processes on '
        f'{os.cpu_count()} cores'
    )


if __name__ == '__main__':
    main()
