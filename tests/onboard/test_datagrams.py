"""Reception on real sockets of the loopback."""

import socket
import time

import numpy as np
import pytest

from flightlog.errors import SourceError
from onboard.datagrams import Receiver, open_udp

SLOT = np.dtype({"names": ["head", "data"], "formats": ["V8", "V100"], "offsets": [0, 8], "itemsize": 112})


def test_datagrams_land_in_their_slots_with_size_and_kernel_time(sender: socket.socket, free_port: int) -> None:
    slots = np.zeros(8, SLOT)
    with open_udp("127.0.0.1", free_port, 1 << 20) as sock:
        receiver = Receiver(sock, slots, 8, 100)
        assert receiver.receive() == 0
        time.sleep(0.5)  # the kernel switches its stamping on in the background
        before = time.time_ns()
        for size in (100, 3, 101, 0, 1400):
            sender.sendto(bytes(range(100)).ljust(size, b"\xff")[:size], ("127.0.0.1", free_port))
        after = time.time_ns()
        time.sleep(0.2)  # reading late must not matter
        assert receiver.receive(2) == 5
    assert receiver.sizes[2:7].tolist() == [100, 3, 101, 0, 101]
    stamps = receiver.stamps_ns[2:7]
    assert (np.diff(stamps) >= 0).all()
    assert before <= stamps[0]
    assert stamps[-1] <= after
    assert slots["data"][2].tobytes() == bytes(range(100))
    assert slots["data"][3].tobytes()[:4] == b"\x00\x01\x02\x00"
    assert slots["data"][4].tobytes() == bytes(range(100))
    assert slots.view(np.uint8).reshape(8, 112)[:, 108:].max() == 0  # nothing runs over
    assert not slots.view(np.uint8).reshape(8, 112)[:2].any()


def test_a_socket_is_emptied_over_several_calls_in_order(sender: socket.socket, free_port: int) -> None:
    slots = np.zeros(16, SLOT)
    numbers: list[int] = []
    with open_udp("127.0.0.1", free_port, 1 << 20) as sock:
        receiver = Receiver(sock, slots, 8, 100)
        for number in range(100):
            sender.sendto(number.to_bytes(4, "little"), ("127.0.0.1", free_port))
        while count := receiver.receive():
            numbers += [int.from_bytes(slots["data"][i].tobytes()[:4], "little") for i in range(count)]
        assert receiver.drops == 0
    assert numbers == list(range(100))


@pytest.mark.parametrize("told_by", ["a later datagram", "the kernel when asked"])
def test_the_kernel_counts_exactly_what_was_lost(sender: socket.socket, free_port: int, told_by: str) -> None:
    sent = received = 0
    with open_udp("127.0.0.1", free_port, 4096) as sock:
        receiver = Receiver(sock, np.zeros(64, SLOT), 8, 100)
        for _ in range(3):
            for _ in range(500):
                sender.sendto(bytes(100), ("127.0.0.1", free_port))
            sent += 500
            while count := receiver.receive():
                received += count
        if told_by == "a later datagram":
            sender.sendto(bytes(100), ("127.0.0.1", free_port))
            sent, received = sent + 1, received + receiver.receive()
        else:
            receiver.count_last_drops()
    assert received < sent - 1000  # the buffer was really too small
    assert receiver.drops == sent - received


def test_a_port_in_use_is_one_sentence(free_port: int) -> None:
    with open_udp("127.0.0.1", free_port, 4096), pytest.raises(SourceError) as caught:
        open_udp("127.0.0.1", free_port, 4096)
    assert str(caught.value) == f"UDP port {free_port} at 127.0.0.1 cannot be opened: another program has it"


def test_an_address_that_is_not_ours_is_one_sentence(free_port: int) -> None:
    with pytest.raises(SourceError, match=r"192\.0\.2\.1 cannot be opened: Cannot assign requested address"):
        open_udp("192.0.2.1", free_port, 4096)
