"""Hosts on this machine, each a network namespace, between which every packet takes as long as is asked (root only)."""

import fcntl
import heapq
import os
import select
import struct
import subprocess
import threading
import time
from contextlib import contextmanager

SET_NAME, TUN_WITHOUT_HEADER, MTU = 0x400454CA, 0x1001, 65_000


def ip(*words):
    subprocess.run(["ip", *map(str, words)], check=True)


@contextmanager
def hosts(count, delay):
    """The beginning of a command that is to run on each host: a network namespace with a `/dev/shm` of its own.

    Host i has the address 10.77.0.(i + 1), and the interface `lemI`.

    Args:
        count: of hosts, at most 200.
        delay: of a packet, one way, in seconds; the relay adds some 50 µs.
    """
    names = [f"lemniscate-{i}" for i in range(count)]
    ends = {}
    try:
        for i, name in enumerate(names):
            ip("netns", "add", name)
            end = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
            ends[i + 1] = end
            fcntl.ioctl(end, SET_NAME, struct.pack("16sH", f"lem{i}".encode(), TUN_WITHOUT_HEADER))
            ip("link", "set", f"lem{i}", "netns", name)
            ip("-n", name, "addr", "add", f"10.77.0.{i + 1}/24", "dev", f"lem{i}")
            ip("-n", name, "link", "set", f"lem{i}", "up", "mtu", MTU)
            ip("-n", name, "link", "set", "lo", "up")
        threading.Thread(target=_relay, args=(ends, delay), daemon=True).start()
        alone = ("sh", "-c", 'mount -t tmpfs none /dev/shm && exec "$@"', "-")
        yield [["ip", "netns", "exec", name, *alone] for name in names]
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "del", name], stderr=subprocess.DEVNULL)
        for end in ends.values():
            os.close(end)


def _relay(ends, delay):
    """Carry packets of IPv4 to the host whose address they name, `delay` seconds after they came."""
    on_the_way, count = [], 0
    while True:
        wait = max(0.0, on_the_way[0][0] - time.monotonic()) if on_the_way else 0.1
        try:
            for end in select.select(ends.values(), [], [], wait)[0]:
                packet = os.read(end, MTU + 100)
                if packet[0] >> 4 == 4:
                    heapq.heappush(on_the_way, (time.monotonic() + delay, count := count + 1, packet))
            while on_the_way and on_the_way[0][0] <= time.monotonic():
                packet = heapq.heappop(on_the_way)[2]
                if packet[19] in ends:
                    os.write(ends[packet[19]], packet)
        except BlockingIOError:
            continue
        except OSError:  # the hosts are gone
            return
