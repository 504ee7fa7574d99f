"""Publishers that send what they must not, next to a room that they must not affect."""
import random, time
from pathlib import Path
from common import check
from room_client import BYE, CREDIT, GEOMETRY, HELLO, SNAPSHOT, Readers, Socket, Viewer, field, fields, hello, publisher, video


def units(stream):
    """Splits an H.264 stream into access units with one picture slice each; returns (data, is_key)."""
    data, starts = Path(stream).read_bytes(), []
    at = data.find(b"\0\0\1")
    while at >= 0:
        starts.append(at - 1 if at and data[at - 1] == 0 else at)
        at = data.find(b"\0\0\1", at + 3)
    units, unit = [], b""
    for start, stop in zip(starts, starts[1:] + [len(data)]):
        nal = data[start:stop]
        kind = nal[nal.index(1) + 1] & 31
        unit += nal
        if kind in (1, 5):
            units.append((unit, kind == 5))
            unit = b""
    return units


def hostile(server, stream, table, full):
    room = "/v1/live/cellar/publish"
    pictures = units(stream)

    def connect(first=None):
        # the previous publisher may still be connected
        for _ in range(200):
            client = Socket(server, room)
            if first is None:
                return client
            client.send(first)
            for message in client.receive(5):
                if CREDIT in fields(message):
                    return client
                break
            client.close()
            time.sleep(0.05)
        raise SystemExit("the room is still taken")

    def on_connect(action):
        def play():
            client = connect()
            action(client)
            return client
        return play

    def after_hello(action, first=hello()):
        def play():
            client = connect(first)
            action(client)
            return client
        return play

    def flood(client):
        began, number = time.monotonic(), 0
        while number < 10_000 and time.monotonic() - began < 10:
            client.send(video(number, pictures[number % len(pictures)][0], number == 0))
            number += 1

    def mutated(count):
        def play(client):
            rng, credit, number = random.Random(1), 2, 0
            sent = 0
            while sent < count:
                while credit:
                    unit, key = pictures[sent % len(pictures)]
                    data = bytearray(unit)
                    for _ in range(rng.randrange(1, 20)):
                        data[rng.randrange(len(data))] = rng.randrange(256)
                    client.send(video(number, bytes(data), key or number == 0))
                    credit, number, sent = credit - 1, number + 1, sent + 1
                for message in client.receive(10):
                    kinds = fields(message)
                    if CREDIT in kinds:
                        credit += fields(kinds[CREDIT]).get(1, 0)
                        break
                    if BYE in kinds:
                        mutated.reasons.append(fields(kinds[BYE]).get(1, b"").decode())
                        client.close()
                        new = connect(hello())
                        client.socket, client.buffer = new.socket, new.buffer
                        credit, number = 2, 0
                        break
                else:
                    return
            client.send(field(HELLO, b""))
        return play

    mutated.reasons = []
    many = 200_000 if full else 3_000
    cases = [
        ("a text message", on_connect(lambda c: c.raw(0x81, b"hello")), "binary"),
        ("bytes that are no message", on_connect(lambda c: c.send(b"\xff" * 60)), "not a readable message"),
        ("an empty message", on_connect(lambda c: c.send(b"")), "unknown kind"),
        ("video before HELLO", on_connect(lambda c: c.send(video(0, b"x", True))), "HELLO"),
        ("unknown version", on_connect(lambda c: c.send(hello(version=9))), "version"),
        ("100 000×9 frames", on_connect(lambda c: c.send(hello(size=(100_000, 9)))), "100000"),
        ("an unknown codec", on_connect(lambda c: c.send(hello("hev1.1"))), "hev1"),
        ("half a million empty chunks", on_connect(lambda c: c.send(field(GEOMETRY, b"\x12\0" * 500_000))), "chunks"),
        ("a frame that claims 4 EiB", on_connect(lambda c: c.raw(0x82, b"x", 1 << 62)), ""),
        ("2 MiB of fragments", on_connect(lambda c: [c.raw(0x02, bytes(4096))] + [c.raw(0x00, bytes(4096)) for _ in range(511)]), ""),
        ("no message", on_connect(lambda c: None), "nothing came"),
        ("first frame is no key frame", after_hello(lambda c: c.send(video(0, b"x"))), "key"),
        ("frames out of order", after_hello(lambda c: [c.send(video(0, pictures[0][0], True)), c.send(video(5, b"x"))]), "was due"),
        ("a frame of 1 MiB + 1 byte", after_hello(lambda c: c.send(video(0, bytes((1 << 20) + 1), True))), "over"),
        ("a message for viewers", after_hello(lambda c: c.send(field(SNAPSHOT, b""))), "do not send"),
        ("10 000 frames at once", after_hello(flood), "credit"),
        ("invalid video", after_hello(lambda c: [c.send(video(0, b"\0\0\1\x65zzz", True)), c.send(video(1, b"", True))]), "nothing came"),
        (f"{many} damaged frames", after_hello(mutated(many)), "do not send"),
        ("no message after HELLO", after_hello(lambda c: None), "nothing came"),
    ]
    publishing = publisher(server, "attic", stream)
    watcher, readers = Viewer(server, "attic"), Readers()
    readers.add(watcher)
    for name, play, words in cases:
        frames, began = watcher.frames, time.monotonic()
        try:
            client = play()
            reason = client.bye_reason(20)
            client.close()
        except OSError as error:
            reason = f"connection lost ({error})" if not words or "credit" in words else f"no reason: {error}"
        took = time.monotonic() - began
        check(reason is not None, f"{name}: disconnected within 20 s")
        reason = reason or ""
        check(words in reason or reason.startswith("connection lost"), f"{name}: disconnected with {words!r}: {reason!r}")
        rate = (watcher.frames - frames) / max(took, 0.1)
        table.row(name, reason[:70], f"{took:.1f} s", f"{server.resident_mib():.0f} MiB", f"{rate:.0f}" if took > 1 else "", watcher.lost)
    check(watcher.lost == 0 and not readers.closed, f"another room is not affected: {watcher.lost} frames lost")
    sender = Socket(server, "/v1/live/attic/subscribe")
    sender.send(hello())
    reason = sender.bye_reason(20)
    check("viewers" in (reason or ""), f"a viewer that sends is disconnected: {reason!r}")
    readers.stop()
    publishing.kill()
    publishing.wait()
    return mutated.reasons
