"""Who may send to the lidar's ports, with real sockets: on the loopback, and over a cable between network namespaces."""

import select
import socket
import struct
import time
from collections.abc import Callable

import numpy as np
import pytest
from lidar_stream import cable, from_address, inside, needs_namespaces, packet, run

from flightlog import records
from onboard import lidarsender, lidarstate
from onboard.batch import Batch
from onboard.config import FovConfig, LidarConfig
from onboard.lidar import LidarPort
from onboard.readings import LidarReadings, Rates
from onboard.timesync import LogTime, read_clocks

SENSOR, STRANGER = "127.0.0.2", "127.0.0.3"


class Port:
    """A lidar port of ours and what it handed over."""

    def __init__(
        self,
        address: str = "127.0.0.1",
        sensor: str | None = None,
        ports: tuple[int, int] | None = None,
        interface: str | None = None,
    ) -> None:
        self.ports = ports or (free_port(), free_port())
        self.messages: list[tuple[str, bytes]] = []
        config = LidarConfig(
            address, *self.ports, poll_ms=20, receive_buffer_kb=2048, fov=FovConfig(0, 0), sensor=sensor,
            interface=interface, only_interface=interface is not None,
        )  # fmt: skip
        self.log_time = LogTime.start(read_clocks())
        self.port = LidarPort(config, self.log_time, self.put)
        self.port.start()

    def put(self, topic: str, log_time_ns: int, data: bytes, vital: bool) -> bool:
        del log_time_ns, vital
        self.messages.append((topic, data))
        return True

    def stop(self) -> None:
        sockets = [self.port._data_socket, self.port._position_socket]
        until(lambda: not select.select(sockets, [], [], 0)[0])
        self.port.stop()
        assert self.port.failure is None

    def marks(self) -> dict[int, int]:
        """Packets recorded by the mark in them."""
        scans = [records.decode_scan(data) for topic, data in self.messages if topic == records.LIDAR.topic]
        if not scans:
            return {}
        values, counts = np.unique(
            np.concatenate(scans)["data"]["blocks"]["returns"]["intensity"][:, 0, 0], return_counts=True
        )
        return dict(zip(values.tolist(), counts.tolist(), strict=True))

    def account(self, name: str) -> int:
        accounts = [
            records.decode_account(data) for topic, data in self.messages if topic == records.LIDAR_ACCOUNT.topic
        ]
        return sum(getattr(account, name) for account in accounts)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def until(condition: Callable[[], bool], seconds: float = 90.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.01)


def test_a_flood_of_look_alikes_never_reaches_the_file_and_costs_the_lidar_nothing() -> None:
    port = Port()
    to = ("127.0.0.1", port.ports[0])
    with from_address(SENSOR) as sensor, from_address(STRANGER) as stranger:
        for number in range(10):
            sensor.sendto(packet(number), to)
        until(lambda: port.port.counts.sensor == SENSOR)
        hostile, sent = packet(5, mark=66), 0
        for number in range(10, 400):
            sensor.sendto(packet(number), to)
            for _ in range(20):
                stranger.sendto(hostile, to)
                sent += 1
            if number % 20 == 0:
                time.sleep(0.01)
    port.stop()
    assert port.marks() == {1: 400}
    assert port.account("kernel_drops") == 0  # what the filter refuses is no loss
    assert port.account("rejected_sender") == sent
    assert port.account("received") == 400 + sent
    assert port.port.counts.rejected[lidarstate.REFUSED] > 0.99 * sent  # none of these reached us


def test_a_lidar_named_in_the_configuration_is_the_only_one_from_the_first_packet() -> None:
    port = Port(sensor=SENSOR)
    to = ("127.0.0.1", port.ports[0])
    with from_address(SENSOR) as sensor, from_address(STRANGER) as stranger:
        for number in range(50):
            stranger.sendto(packet(number, mark=66), to)
        until(lambda: port.port.counts.rejected[lidarstate.WRONG_SENDER] == 50)
        assert port.port.counts.newest_ns == 0
        for number in range(50):
            sensor.sendto(packet(number), to)
    port.stop()
    assert port.marks() == {1: 50}
    assert port.account("rejected_sender") == 50


def test_a_stranger_may_not_take_over_from_a_silent_lidar_before_it_is_forgotten(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(lidarsender, "_OPEN_NS", 200_000_000)
    monkeypatch.setattr(lidarsender, "_FORGET_NS", 3600_000_000_000)
    port = Port()
    to = ("127.0.0.1", port.ports[0])
    with from_address(SENSOR) as sensor, from_address(STRANGER) as other:
        sensor.sendto(packet(0), to)
        until(lambda: port.port.counts.sensor == SENSOR)
        until(
            lambda: not port.port._sender._is_filtered
        )  # the kernel lets all in again, to tell why the lidar is silent
        other.sendto(packet(1, mark=66), to)
        until(lambda: port.port.counts.rejected[lidarstate.WRONG_SENDER] == 1)
        other.sendto(packet(1)[:-1], to)
        until(lambda: port.port.counts.rejected[lidarstate.WRONG_LENGTH] == 1)
        assert port.marks() == {1: 1}
        monkeypatch.setattr(lidarsender, "_FORGET_NS", 1_000_000)  # it was set to another address
        until(lambda: port.port._sender.address is None)
        other.sendto(packet(2, mark=7), to)
        until(lambda: port.port.counts.sensor == STRANGER)
    port.stop()
    assert port.marks() == {1: 1, 7: 1}


def test_position_packets_of_another_sender_are_not_the_lidars() -> None:
    port = Port()
    position = struct.pack("<14x12H", *[tag << 12 for tag in range(4)] * 3).ljust(512, b"\0")
    with from_address(SENSOR) as sensor, from_address(STRANGER) as stranger:
        sensor.sendto(packet(0), ("127.0.0.1", port.ports[0]))
        until(lambda: port.port.counts.sensor == SENSOR)
        for _ in range(5):
            stranger.sendto(position, ("127.0.0.1", port.ports[1]))
        for _ in range(3):
            sensor.sendto(position, ("127.0.0.1", port.ports[1]))
    port.stop()
    assert port.port.counts.position_kept == 3
    assert sum(count for reason, count in port.port.counts.rejected.items() if reason.startswith("position")) == 5


def test_a_full_buffer_is_a_loss_and_not_a_refusal() -> None:
    port = Port()
    to = ("127.0.0.1", port.ports[0])
    with from_address(SENSOR) as sensor:
        sensor.sendto(packet(0), to)
        until(lambda: port.port.counts.sensor == SENSOR)
        receiver = port.port._data.receiver
        port.port.stop()  # nobody empties the socket from here on
    assert receiver.refused == 0

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock, from_address(SENSOR) as sensor:
        sock.bind(("127.0.0.1", 0))
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
        slow = Batch(sock, records.SCAN_PACKET_DTYPE, 8, 1206, 512, LogTime(0), 0.02)
        slow.receiver.filter(1206, int.from_bytes(socket.inet_aton(SENSOR)))
        for number in range(500):
            sensor.sendto(packet(number), sock.getsockname())
        found = 0
        while count := slow.fill():
            found += count
        slow.receiver.count_last_drops()
        assert found < 400
        assert (slow.receiver.drops, slow.receiver.refused) == (500 - found, 0)


@pytest.mark.root
def test_the_addresses_of_old_firmware_are_heard() -> None:
    needs_namespaces()
    with cable(["192.168.3.1/24"], ["192.168.17.162/32"]) as (aboard, sensor):
        run("ip", "-n", sensor, "route", "add", "broadcast", "192.168.3.255", "dev", "head0", "src", "192.168.17.162")
        port = inside(aboard, lambda: Port("0.0.0.0", ports=(2368, 8308)))
        with inside(sensor, lambda: from_address("192.168.17.162", 443)) as sock:
            for number in range(100):
                sock.sendto(packet(number), ("192.168.3.255", 2368))
        port.stop()
        assert port.port.counts.sensor == "192.168.17.162"
        assert port.marks() == {1: 100}


@pytest.mark.root
def test_the_addresses_of_new_firmware_are_heard_and_broadcasts_of_others_refused() -> None:
    needs_namespaces()
    with cable(["192.168.1.10/24"], ["192.168.1.201/24", "192.168.1.66/24"]) as (aboard, sensor):
        run("ip", "-n", sensor, "route", "add", "default", "dev", "head0", "src", "192.168.1.201")
        port = inside(aboard, lambda: Port("0.0.0.0", ports=(2368, 8308)))
        with (
            inside(sensor, lambda: from_address("192.168.1.201", 2368)) as lidar_head,
            inside(sensor, lambda: from_address("192.168.1.66", 2368)) as stranger,
        ):
            lidar_head.sendto(packet(0), ("255.255.255.255", 2368))
            until(lambda: port.port.counts.sensor == "192.168.1.201")
            for number in range(1, 300):
                lidar_head.sendto(packet(number), ("255.255.255.255", 2368))
                for _ in range(5):
                    stranger.sendto(packet(number, mark=66), ("255.255.255.255", 2368))
        port.stop()
        assert port.marks() == {1: 300}
        assert port.account("rejected_sender") == 299 * 5
        assert port.account("kernel_drops") == 0


@pytest.mark.root
def test_the_lidars_own_address_by_another_interface_is_refused_and_the_interface_may_come_late(
    caplog: pytest.LogCaptureFixture,
) -> None:
    needs_namespaces()
    lidar_address, forged = "192.168.1.201", packet(7, mark=66)
    with cable(["192.168.1.10/24"], [f"{lidar_address}/24"]) as (aboard, sensor):
        run("ip", "-n", aboard, "link", "set", "lidar0", "name", "late0")
        port = inside(aboard, lambda: Port("0.0.0.0", ports=(2368, 8308), interface="lidar0"))
        # on another cable of the vehicle somebody says that it is the lidar
        run("ip", "-n", aboard, "link", "add", "other0", "type", "veth", "peer", "name", "evil0", "netns", sensor)
        run("ip", "-n", aboard, "link", "set", "other0", "up")
        run("ip", "-n", sensor, "link", "set", "evil0", "up")
        attacker = inside(sensor, lambda: from_address(lidar_address))
        attacker.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"evil0")

        def forge(count: int) -> None:
            for _ in range(count):
                attacker.sendto(forged, ("192.168.1.10", 2368))

        def head(first: int, last: int) -> None:
            with inside(sensor, lambda: from_address(lidar_address, 2368)) as sock:
                for number in range(first, last):
                    sock.sendto(packet(number), ("192.168.1.10", 2368))

        with attacker:
            forge(10)
            head(0, 10)  # by the right cable, but the interface has another name yet
            time.sleep(0.3)
            assert port.marks() == {}
            assert (
                caplog.messages.count("network interface lidar0 is not there, and only what comes by it is let in") == 1
            )
            run("ip", "-n", aboard, "link", "set", "late0", "down")
            run("ip", "-n", aboard, "link", "set", "late0", "name", "lidar0")
            run("ip", "-n", aboard, "link", "set", "lidar0", "up")
            until(lambda: bool(port.port._sender._interface))
            forge(10)
            head(10, 50)
            until(lambda: port.port.counts.sensor == lidar_address)
            forge(10)
            head(50, 100)
        port.stop()
    assert port.marks() == {1: 90}
    assert port.account("rejected_sender") == 40  # 30 forged ones, and ten by an interface that was not yet the lidar's
    assert port.account("kernel_drops") == 0


@pytest.mark.parametrize(("lose", "mode", "state"), [(4, 0x37, "rate low"), (0, 0x37, "good"), (0, 0x39, "rate low")])
def test_a_rate_is_low_by_what_return_mode_and_field_of_view_promise(lose: int, mode: int, state: str) -> None:
    """On a clock of the test's own: what a second brings is sent, then a second has passed."""
    port, rates = Port(), Rates()
    readings = LidarReadings(port.port, None)
    found, sent, log_ns = [], 0, port.log_time.at(read_clocks())
    # of a sensor in dual return mode that sends as one in single return mode does, half is missing
    second = [packet(number, mode=mode) for number in range(1808) if not lose or number % lose]
    with from_address(SENSOR) as sensor:
        for _ in range(6):
            for start in range(0, len(second), 200):
                for one in second[start : start + 200]:
                    sensor.sendto(one, ("127.0.0.1", port.ports[0]))
                sent += len(second[start : start + 200])
                until(lambda sent=sent: port.port.counts.good == sent)
            log_ns += 1_000_000_000
            port.port.counts.newest_ns = log_ns - 50_000_000
            rates.begin(log_ns)
            found.append(readings.status(log_ns, rates.per_second).state)
    port.stop()
    assert found[:2] == ["good", "good"]  # not known yet
    assert found[-1] == state


def test_the_interface_of_a_sensor_is_the_one_on_the_way_back_to_it() -> None:
    assert lidarstate.interface_towards(0x7F000002) == "lo"
    assert lidarstate.carrier("lo") is True
    assert lidarstate.carrier("no-such-interface") is None
