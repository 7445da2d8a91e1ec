"""Numbers, words, points and elements of the page, by the page's own modules."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from .stage import ARM, NOW

if TYPE_CHECKING:
    from .stage import Stage

pytestmark = pytest.mark.system
NONE = None
TEN = "2026-11-25T10:00:00Z"
YESTERDAY = {"at": NOW - 86_400}


def test_a_number_has_the_digits_that_its_uncertainty_allows(stage: Stage) -> None:
    stage.table(
        "format.number(...one)",
        [
            ([12.3456, 0.012], "12.346"),
            ([12.3456, 0.1], "12.35"),
            ([12.3456, 0.0999999999], "12.35"),
            ([12.3456, 1], "12.3"),
            ([12.3456, 20], "12"),
            ([12.3456, 0], "12.346"),
            ([12.3456, 1e-12], "12.345600000"),
            ([12.3456], "12.346"),
            ([1234.56], "1234.6"),
            ([99999.4], "99999"),
            ([123456.7], "123457"),
            ([0], "0"),
            ([-5], "\u22125.0000"),
            ([0.0001], "0.00010000"),
            ([0.00009], "9.0000e\u22125"),
            ([-0.00009], "\u22129.0000e\u22125"),
            ([0.00002, 0.001], "0.0000"),
            ([9_999_999], "9999999"),
            ([10_000_000], "1.0000e+7"),
            ([NONE], "none"),
            (["5"], "none"),
            ([float("inf")], "none"),
        ],
    )
    stage.table(
        "format.short(one)",
        [(1234.56, "1235"), (2.5, "2.5"), (-1, "\u22121"), (-1e-7, "\u22121e\u22127"), (NONE, "none"), ("1", "none")],
    )
    turn = {"low": 0, "high": 360, "turn": NONE}
    stage.table("format.reading(...one)", [([0.1, turn], "0.10000"), ([1e-8, turn], "0")])
    stage.table(
        "format.within(...one)",
        [
            ([12.34567, 0, 20], 12.35),
            ([123.456, 0, 123.456], 123.456),
            ([0.12344, 0.12344, 5], 0.12344),
            ([-1e-7, -1e-7, NONE], -1e-7),
            ([5, 5, NONE], 5),
            ([-5, NONE, NONE], -5),
            ([109.99999940395355, 0, 109.99999940395355], 110),  # 0.11 m with 32 bits, in mm
            ([-109.99999940395355, -109.99999940395355, 0], -110),
            ([109.9999, 0, 109.9999], 109.9999),
        ],
    )


def test_who_holds_a_node_and_whether_a_newer_datasheet_was_written(stage: Stage) -> None:
    """`older_than` was in the answer, and nowhere on the page."""
    nobody: dict[str, Any] = {"holders": {}, "epoch": NONE, "written_by": NONE, "older_than": NONE, "firmware": NONE}
    held = {"holders": {"a1": ["north"], "b2": ["south"]}, "epoch": 3, "sequence": 7, "written_by": "west"}
    runs = {"text": "nrf/loadcell", "version": "1.3.0", "build": NONE, "by": "south"}
    stage.table(
        "format.heldBy(one)",
        [
            (nobody, "no holder, firmware not reported"),
            (
                {**nobody, **held, "firmware": runs},
                "held by north, south (epoch 3), datasheet 7 by west, firmware nrf/loadcell 1.3.0 (seen by south)",
            ),
            (
                {**nobody, "older_than": "west", "firmware": {"version": NONE, "by": "south"}},
                "no holder, firmware not reported (asked by south); the datasheet known here is older than west wrote",
            ),
        ],
    )


def test_what_has_no_number_says_why(stage: Stage) -> None:
    plain, bare = {"number": 1, "uncertainty": 0.1}, {"number": 1, "problem": "no calibration"}
    stage.table(
        "format.figure(...one)",
        [
            ([NONE, plain], "no value yet"),
            ([{"value": 5}, plain], "5.00"),
            ([{"value": NONE}, plain], "not valid"),
            ([{"value": NONE, "raw": 7}, plain], "not valid"),
            ([{"value": NONE, "raw": 2048}, bare], "2048 raw"),
            ([{"value": NONE, "raw": -3}, bare], "\u22123 raw"),
            ([{"value": NONE, "raw": 1.23456789}, bare], "1.23457 raw"),
            ([{"value": NONE, "raw": "0" * 16}, bare], f"{'0' * 16} raw"),
            ([{"value": NONE, "raw": "0" * 17}, bare], "raw value only"),
            ([{"value": NONE}, bare], "raw value only"),
        ],
    )
    report = {
        "invalid_why": [
            {"channel": 1, "count": 3, "why": "out of range"},
            {"channel": 2, "count": 9, "why": "another channel"},
            {"channel": 1, "count": 1, "why": "no answer"},
        ]
    }
    stage.table(
        "format.whyNoNumber(...one)",
        [
            ([{"value": NONE}, plain, report], "3: out of range; 1: no answer"),
            ([{"value": NONE}, bare, report], "no calibration"),
            ([{"value": 0}, bare, report], ""),
            ([NONE, bare, report], ""),
            ([{"value": NONE}, plain, NONE], ""),
        ],
    )


def test_a_time_of_today_has_no_date_and_what_is_no_time_stays(stage: Stage) -> None:
    stage.table(
        "format.clock(one)",
        [
            (NOW, "10:00:00"),
            ("2026-11-25T10:00:07Z", "10:00:07"),
            (NOW - 36_000.5, "2026-11-24 23:59:59"),
            (0, "1970-01-01 00:00:00"),
            (NONE, "never"),
            ("", "never"),
            ("some day", "some day"),
        ],
    )


def test_ages_rates_ranges_and_numbers_of_things_are_short_words(stage: Stage) -> None:
    stage.table(
        "format.age(one)",
        [
            (NONE, "never"), (0, "now"), (1.4, "now"), (1.5, "2 s ago"), (89.4, "89 s ago"), (90, "2 min ago"),
            (5399, "90 min ago"), (5400, "2 h ago"), (129_599, "36 h ago"), (129_600, "2 days ago"),
            (864_000, "10 days ago"), (-5, "now"),
        ],
    )  # fmt: skip
    stage.table(
        "format.hertz(one)",
        [(NONE, "not stated"), (0, "not stated"), (-1, "not stated"), (0.5, "0.5 Hz"), (999.94, "999.9 Hz"),
         (1000, "1 kHz"), (2500, "2.5 kHz")],
    )  # fmt: skip
    stage.table(
        "format.range(one)",
        [
            ({"low": 0, "high": 110, "unit": "mm"}, "0 to 110 mm"), ({"low": 0, "high": 0, "unit": ""}, "0 to 0"),
            ({"low": -5, "high": NONE, "unit": "V"}, "from \u22125 V"), ({"high": 5, "unit": "V"}, "up to 5 V"),
            ({"unit": "V"}, "not stated"),
        ],
    )  # fmt: skip
    stage.table(
        "format.count(...one)",
        [([0, "node"], "0 nodes"), ([1, "node"], "1 node"), ([2, "node"], "2 nodes"),
         ([1, "entry", "entries"], "1 entry"), ([2, "entry", "entries"], "2 entries")],
    )  # fmt: skip
    stage.table(
        "format.nameOf(one)",
        [({"name": "x", "uuid": ARM}, "x"), ({"name": "", "uuid": ARM}, "node a1a1a1a1"), (NONE, "unknown node")],
    )


def test_names_and_keys_are_written_as_people_compare_them(stage: Stage) -> None:
    stage.table("format.grouped(one)", [("abcdef01", "abcd ef01"), ("abcde", "abcd e"), (NONE, "")])
    stage.table(
        "format.channelName(one)", [({"name": "", "number": 3}, "channel 3"), ({"name": "x", "number": 3}, "x")]
    )
    nodes = [
        {"uuid": uuid, "name": name}
        for name, uuid in (("Arm 10", "aa"), ("arm 2", "bb"), ("", "ab" * 10), ("b", "02"), ("b", "01"))
    ]
    order = stage.run("return words[0].sort(format.byName).map((one) => one.uuid)", nodes)
    assert order == ["bb", "aa", "01", "02", "ab" * 10], "by number, without regard to case; equal names by UUID"


def test_each_verdict_has_its_tone_its_word_and_its_meaning(stage: Stage) -> None:
    absent = {"present": False, "read": {"at": NOW}}
    stage.table(
        "format.verdict(one).slice(0, 3)",
        [
            ({"verdict": "authentic"}, ["good", "good", "Authentic"]),
            ({"verdict": "unproven"}, ["warn", "ask", "Unproven"]),
            ({"verdict": "unsigned"}, ["warn", "warn", "Unsigned"]),
            ({"verdict": "not authentic"}, ["bad", "bad", "Not authentic"]),
            ({"verdict": "unheard of"}, ["plain", "ask", "Not checked"]),
            ({"verdict": "not authentic", "unverified": True}, ["warn", "warn", "Unverified"]),
            ({"verdict": "not authentic", "from": "kept"}, ["bad", "bad", "Not authentic"]),
            ({"verdict": "not authentic", **absent}, ["plain", "bad", "Not authentic at 10:00:00"]),
            ({"verdict": "authentic", **absent, "read": YESTERDAY}, ["plain", "good", "Authentic on 2026-11-24"]),
            ({"verdict": "authentic", **absent, "read": NONE}, ["plain", "good", "Authentic"]),
            ({"verdict": "authentic", **absent, "present": True}, ["good", "good", "Authentic"]),
            ({"verdict": "authentic", "present": True, "problem": {}}, ["warn", "ask", "Not verified"]),
            (
                {"verdict": "authentic", "present": True, "problem": {}, "measuring": {"state": "running"}},
                ["good", "good", "Authentic"],
            ),
            ({"present": True, "problem": {}}, ["plain", "ask", "Not checked"]),
        ],
    )  # fmt: skip
    meanings = stage.run(
        "return words.map((verdict) => format.verdict({ verdict })[3])", "authentic", "unproven", "unsigned",
        "not authentic",
    )  # fmt: skip
    assert meanings == [
        "Signature, trust and key proof are valid.",
        "The node could not prove that it holds its key.",
        "Nobody signed this datasheet.",
        "A security check failed. Do not trust its values.",
    ]


def test_the_stations_links_and_vault_are_shown_by_their_short_names(stage: Stage) -> None:
    problem = {"message": "It is locked.", "hint": "Unlock it."}
    wire = {
        "time": "2026-11-25T10:00:00Z",
        "started": NOW - 5,
        "vault": {"problem": problem},
        "links": [
            {"place": "can:socketcan:can0", "via": "can", "state": "up", "nodes": 3},
            {"place": "nfc:usb", "via": "nfc", "state": "waiting", "waiting": "no reader"},
            {"place": "ble:hci0", "via": "ble", "state": "failed", "problem": problem, "waiting": "else"},
            {"virtual": True, "place": "can:x", "via": "can", "state": "up"},
        ],
    }
    found = stage.run("return shapes.status(words[0])", wire)
    assert [(link["name"], link["kind"], link["virtual"]) for link in found["links"]] == [
        ("socketcan:can0", "can", False),
        ("usb", "nfc", False),
        ("hci0", "ble", False),
        ("virtual transducers", "virtual", True),
    ]
    assert [(link["why"], link["hint"], link["nodes"]) for link in found["links"]] == [
        ("", "", 3),
        ("no reader", "", NONE),
        ("It is locked.", "Unlock it.", NONE),
        ("", "", NONE),
    ]
    assert (found["now"], found["started"]) == (NOW, NOW - 5)
    assert found["vaultProblem"] == "It is locked. Unlock it."
    assert stage.run("return shapes.status({}).vaultProblem") == ""


def test_a_node_is_what_the_station_read_of_it(stage: Stage) -> None:
    wire = {
        "via": "can", "last_seen": TEN, "verified": NOW, "problem": {"message": "why", "hint": "how"},
        "verdict": {"verdict": "authentic", "checks": [1], "from": "session", "at": TEN, "by": "ncap"},
        "channels": [
            {"kind": "event sensor", "low": -1, "high": 2, "uncertainty": -0.5, "unit": "m"},
            {"kind": "actuator", "unit": "m", "shown": {"unit": "mm", "factor": 1000, "offset": 0},
             "actuator": {"value": 0.05, "unit": "m", "safe": False}},
            {"kind": "actuator", "unit": "m", "shown": {"unit": "mm", "factor": 1000, "offset": 0},
             "actuator": {"value": 50, "unit": "mm", "safe": False}},
        ],
    }  # fmt: skip
    found = stage.run("return shapes.node(words[0])", wire)
    assert (found["link"], found["seen"], found["looked"]) == ("can", NOW, NOW)
    assert (found["why"], found["cure"]) == ("why", "how")
    assert (found["verdict"], found["checks"], found["from"], found["read"]) == (
        "authentic", [1], "session", {"at": NOW, "by": "ncap"},
    )  # fmt: skip
    first, metres, millimetres = found["channels"]
    assert (first["kind"], first["uncertainty"], first["name"]) == ("event", 0.5, "")
    assert (metres["actuator"]["value"], millimetres["actuator"]["value"]) == (50, 50)
    nothing = stage.run("return shapes.node({})")
    assert (nothing["verdict"], nothing["read"], nothing["groups"], nothing["channels"], nothing["why"]) == (
        NONE, NONE, [], [], "",
    )  # fmt: skip


def test_what_a_node_does_in_a_measurement_is_a_word(stage: Stage) -> None:
    states = {"running": "measuring", "refused": "refused, not measured", "lost": "lost, not measured",
              "ended": "not measured", "waiting": "waiting to be measured"}  # fmt: skip
    wires = [({"measurement": "m", "measuring": {"state": state}}, words) for state, words in states.items()]
    stage.table("shapes.node(one).mode", [*wires, ({"measurement": "m"}, "waiting to be measured"), ({}, NONE)])


def test_the_points_that_are_kept_are_the_newest_in_their_order(stage: Stage) -> None:
    held = """
      const { Ring } = window.page.ring;
      const ring = new Ring(3);
      const all = () => [...ring.time].slice(0, ring.held).sort();
      const seen = [];
      for (const time of [1, 2, 2, 3, 4]) ring.push(time, 10 * time), seen.push([ring.held, ring.newest]);
      const kept = [...all()];
      ring.push(3.5, 0);
      return [seen, kept, ring.held, ring.newest, ring.total];
    """
    seen, kept, after, newest, total = stage.run(held)
    assert seen == [[1, 1], [2, 2], [3, 2], [3, 3], [3, 4]]
    assert kept == [2, 3, 4]
    assert (after, newest, total) == (1, 3.5, 6), "the clock went back: what was there belongs to another time"
    points = """
      const { Ring } = window.page.ring;
      const ring = new Ring(5);
      [[10, 1], [11, 2]].forEach(([time, value]) => ring.push(time, value));
      ring.before([[8, 7], [9, NaN], [10, 5], [12, 6]]);
      const found = ring.bins(8, 12, 4, 100);
      const empty = new Ring(5);
      empty.before([[8, 7]]);
      const after = [9.5, 10, 99].map((from) => ring.after(from));
      return [ring.held, ring.total, found.map((one) => (one === undefined ? "-" : one)), empty.held, after];
    """
    assert stage.run(points) == [4, 2, [7, 7, "-", NONE, NONE, "-", 1, 1, "-", 2, 2, "-"], 1, [2, 2, 4]]
    assert stage.run("return new ring.Ring().size") == 12_000, "two minutes at a hundred points a second"


def test_a_column_has_the_least_and_the_greatest_in_the_order_of_time(stage: Stage) -> None:
    script = """
      const { Ring } = window.page.ring;
      return words.map(([points, ...rest]) => {
        const ring = new Ring(4);
        points.forEach(([time, value]) => ring.push(time, value ?? NaN));
        return ring.bins(...rest).map((one) => (one === undefined ? "-" : one));
      });
    """
    cases: list[tuple[list[Any], list[Any]]] = [
        ([[[0, 5], [1, 9], [2, 3]], 0, 4, 1, 100], [9, 3, "-"]),
        ([[[0, 5], [1, 3], [2, 9]], 0, 4, 1, 100], [3, 9, "-"]),
        ([[[0, 5], [1, 5], [4, 8]], 0, 4, 2, 100], [5, 5, "-", "-", "-", "-"]),
        ([[[0, 1], [1, 2], [2, 3], [3, 4], [4, 5]], 1, 5, 2, 100], [2, 3, "-", 4, 5, "-"]),
        ([[[0, 1], [1, 2], [2, 3], [3, 4], [4, 5]], 3, 5, 2, 100], [4, 4, "-", 5, 5, "-"]),
        ([[[0, 1], [2, 3]], 1, 3, 2, 100], ["-", "-", "-", 3, 3, "-"]),
        ([[[0, 1], [2.5, 3]], 0, 3, 3, 2.5], [1, 1, "-", "-", "-", "-", 3, 3, "-"]),
        ([[[0, 1], [2.5, 3]], 0, 3, 3, 2.4], [1, 1, "-", "-", "-", NONE, 3, 3, "-"]),
        ([[[0, 1], [1.9, 3]], 0, 2, 2, 1], [1, 1, "-", 3, 3, "-"]),
    ]
    assert stage.run(script, *(case for case, _ in cases)) == [wanted for _, wanted in cases]


PAST = {"bin": 1, "count": [], "invalid": [0, 1, 2], "lost": [0, 3, 0], "segment": [1, 1, 1],
        "segments": [{"id": 1, "unit": "m"}], "rate": 20}  # fmt: skip


def bins(*times: float, unit: str = "m", segment: int = 1, **more: Any) -> dict[str, Any]:
    """Return what the station answers: a bin at each time, whose lowest value is the time's last digits."""
    values = [time % 100 for time in times]
    nothing = [0] * len(times)
    return {
        "bin": 1, "time": list(times), "low": values, "high": values, "count": [1] * len(times), "invalid": nothing,
        "lost": nothing, "segment": [segment] * len(times), "segments": [{"id": segment, "unit": unit}], "rate": 20,
    } | more  # fmt: skip


def test_the_hour_is_fetched_once_and_then_what_is_new(stage: Stage) -> None:
    past = f"GET nodes/{ARM}/past"
    now = stage.run("return hub.now()")
    stage.answers(**{past: bins(now - 3599, now - 100, now - 2, invalid=[0, 0, 4], lost=[0, 7, 1])})
    ask = "window.hour ??= new past.Hour(words[0], 2); await window.hour.refresh(); return window.hour.bins"
    assert len(stage.run(ask, ARM)["time"]) == 3
    assert [entry["path"] for entry in stage.sent] == [
        f"nodes/{ARM}/past?channel=2&from={now - 3600:.3f}&until={now + 5:.3f}&points=3600"
    ]
    faults = "return words.map((one) => window.hour.faults(...one))"
    assert stage.run(faults, [0, 1e12], [now - 100, now - 100], [now - 99, 1e12]) == [
        {"lost": 8, "invalid": 4}, {"lost": 7, "invalid": 0}, {"lost": 1, "invalid": 4},
    ]  # fmt: skip
    stage.pass_time(2000)
    stage.answers(**{past: bins(now - 2, now - 1, now + 1, segment=2, unit="K", low=[50, 51, 52])})
    fresh = stage.run(ask, ARM)
    assert [round(time - now) for time in fresh["time"]] == [-100, -2, -1, 1], "older than an hour is forgotten"
    assert fresh["low"][-3:] == [50, 51, 52], "the last one was not whole when it came"
    assert fresh["segments"] == [{"id": 1, "unit": "m"}, {"id": 2, "unit": "K"}]
    assert stage.run("return window.hour.unit") == "K"
    assert f"&from={now - 68:.3f}&" in stage.sent[0]["path"], "more than a minute: bins of a second"
    stage.pass_time(100_000)
    stage.run(ask, ARM)
    assert f"&from={now + 1:.3f}&" in stage.sent[0]["path"], "all that came since the last one, however long ago"
    stage.answers(**{past: bins(now - 50)})  # the station's clock was set back
    assert [round(time - now) for time in stage.run(ask, ARM)["time"]] == [-50]
    stage.answers(**{past: {"refused": 503, "code": "busy", "message": "no"}})
    assert len(stage.run(ask, ARM)["time"]) == 1, "an error changes nothing"
    stage.answers(**{past: "held"})
    stage.sent  # noqa: B018
    stage.run("window.hour.refresh(); window.hour.refresh(); window.hour = undefined")
    assert len(stage.sent) == 1, "one request at a time"
    stage.run("window.held.forEach((go) => go({ refused: 404 }))")


def test_what_was_never_measured_is_empty_and_another_refusal_is_none(stage: Stage) -> None:
    script = """
      try { return (await past.between("a1", 1, 0, 1.23456, 5)).time; } catch (error) { return error.code; }
    """
    for refused, wanted in ((404, []), (503, "busy")):
        stage.answers(**{"GET nodes/a1/past": {"refused": refused, "code": "busy"}})
        assert stage.run(script) == wanted
    assert stage.sent[0]["path"] == "nodes/a1/past?channel=1&from=0.000&until=1.235&points=5"


def test_a_live_curve_begins_with_what_was_measured_before(stage: Stage) -> None:
    now = stage.run("return hub.now()")
    rough = bins(now - 119, now - 59, now - 57, segment=1) | {"high": [80, 81, 82], "low": [70, 71, 72]}
    fine = bins(now - 57.5, now - 10, segment=1, bin=0.01) | {
        "segment": [1, 2], "segments": [{"id": 1, "unit": "m"}, {"id": 2, "unit": "m"}],
        "low": [60, None], "high": [60, None],
    }  # fmt: skip
    script = """
      const [arm, rough, fine] = words;
      const sent = [];
      window.before ??= window.fetch;
      window.fetch = (address) => {
        const query = new URL(address, location.href).searchParams;
        sent.push([query.get("from"), query.get("until"), query.get("points")].map(Number));
        return Promise.resolve(new Response(JSON.stringify(query.get("points") === "120" ? rough : fine)));
      };
      await past.seed(arm, 1);
      const found = hub.ringOf(arm, 1);
      return [sent, [...found.time].slice(0, found.held), [...found.value].slice(0, found.held)];
    """
    try:
        sent, times, values = stage.run(script, ARM, rough, fine)
        assert [[round(words[0] - now), round(words[1] - now), words[2]] for words in sent] == [
            [-120, -58, 120], [-58, 1, 3600],
        ]  # fmt: skip
        # least and greatest of a second as two points; no rough one after the first fine one; a segment ends the line
        assert [round(time - now, 1) for time in times] == [-119, -118.5, -59, -58.5, -57.5, -10, -10]
        assert values[:5] == [70, 80, 71, 81, 60]
        assert values[5] != values[5]
        fine["segments"][1]["unit"] = "K"
        stage.run("state.rings.clear()")
        assert len(stage.run(script, ARM, rough, fine)[1]) == 1, "of another quantity nothing is drawn"
    finally:
        stage.run("window.fetch = window.before ?? window.fetch; delete window.before")


def test_a_request_says_what_it_is_and_a_refusal_has_cause_and_remedy(stage: Stage) -> None:
    stage.answers(
        **{
            "GET a": {"x": 1, "tag": '"7"'},
            "PUT b": {"refused": 412, "code": "changed", "message": "Another wrote.", "hint": "Look again."},
            "DELETE c": {"refused": 503},
            "GET d": "cut",
        }
    )
    script = """
      const say = async (work) => {
        try { return await work(); }
        catch (error) { return [error.status, error.code, error.message, error.hint]; }
      };
      return [
        await say(() => api.get("a")),
        await say(() => api.change("b", { y: 2 }, { match: '"7"', keepalive: true })),
        await say(() => api.remove("c")),
        await say(() => api.get("d")),
        await say(() => api.send("e", new ArrayBuffer(5))),
        await say(() => api.post("f")),
      ];
    """
    assert stage.run(script) == [
        {"x": 1, "tag": '"7"'},
        [412, "changed", "Another wrote.", "Look again."],
        [503, "503", "Refused (503).", ""],
        [0, "unreachable", "The base station is not responding.", "Is `teds-provision ncap run` still running?"],
        {},
        {},
    ]
    assert stage.sent == [
        {"method": "GET", "path": "a", "body": NONE},
        {"method": "PUT", "path": "b", "body": {"y": 2}, "match": '"7"', "keepalive": True},
        {"method": "DELETE", "path": "c", "body": {}},
        {"method": "GET", "path": "d", "body": NONE},
        {"method": "POST", "path": "e", "body": "5 octets", "kind": "application/octet-stream"},
        {"method": "POST", "path": "f", "body": {}},
    ]
    aborted = """
      const leaving = new AbortController();
      leaving.abort();
      try { await api.get("a", { signal: leaving.signal }); } catch (error) { return error.name; }
    """
    assert stage.run(aborted) == "AbortError"
    assert stage.run("return [api.paths.group('a/b ?'), api.paths.channel('x', 3)]") == [
        "groups/a%2Fb%20%3F",
        "nodes/x/channels/3",
    ]
    assert stage.run("return [api.liveAddress().href, api.sourceAddress('a b').href]") == [
        "ws://127.0.0.1/api/v1/live",
        "ws://127.0.0.1/api/v1/virtual/a%20b/source",
    ]


def test_text_is_never_markup_and_what_cannot_be_seen_is_marked(stage: Stage) -> None:
    hostile = "<b>x</b>\u202egrab\u200b\u0007\ue000"
    shown = "<b>x</b>\ufffdgrab\ufffd\ufffd\ufffd"
    script = """
      const told = { title: words[0], hidden: false, id: null, "data-x": true };
      const one = dom.h("p", told, words[0], null, [["a"], undefined, false, 0]);
      dom.text(dom.put(dom.h("i"), "old"), words[0]);
      const name = document.createElement("span");
      dom.text(name, words[0]);
      const names = [...one.attributes].map((each) => each.name);
      const markup = name.innerHTML;
      return [one.textContent, one.title, one.childElementCount, names, markup, dom.fill(name, "x").textContent];
    """
    found = stage.run(script, hostile)
    assert found[:4] == [f"{shown}a0", shown, 0, ["title", "data-x"]]
    assert found[4] == "&lt;b&gt;x&lt;/b&gt;\ufffdgrab\ufffd\ufffd\ufffd"
    assert found[5] == "x"
    for part in ("chip('bad', 'no-icon', words[0])", "trouble({ message: words[0], hint: words[0] })",
                 "field(words[0], dom.h('input'), words[0])", "button(words[0])", "empty(words[0])"):  # fmt: skip
        assert stage.run(f"return dom.{part}.querySelectorAll('b').length", hostile) == 0
    stage.run("dom.toast('bad', words[0], words[0]); dom.say(words[0])", hostile)
    assert stage.page.locator("#toasts b, #say b").count() == 0
    assert stage.said == shown


def test_a_list_keeps_its_elements_and_their_focus(stage: Stage) -> None:
    script = """
      const list = dom.h("ul");
      document.getElementById("main").append(list);
      let made = 0;
      const make = () => dom.h("li", { tabindex: "0", id: `made-${++made}` });
      const update = (element, one) => dom.text(element, one.words);
      const show = (...items) => dom.keyed(list, items, (one) => one.key, make, update);
      const of = (key, words = key) => ({ key, words });
      const seen = [];
      const look = () => seen.push([list.textContent, made]);
      show(of("a"), of("b"), of("c")), look();
      list.children[1].focus();
      show(of("b", "B"), of("c"), of("b", "twice"), of("d")), look();
      seen.push(document.activeElement.textContent);
      show(of("c"), of("d"), of("b")), look();
      seen.push(document.activeElement.textContent);
      show(of("b"), of("d"), of("c")), look();
      seen.push(document.activeElement.textContent);
      show(of("d"), of("c")), look();
      show(), look();
      return seen;
    """
    assert stage.run(script) == [["abc", 3], ["Bcd", 4], "B", ["cdb", 4], "b", ["bdc", 4], "b", ["dc", 4], ["", 4]]


def test_a_button_works_once_at_a_time_and_a_field_is_named(stage: Stage) -> None:
    script = """
      const one = dom.button("Do", { class: "main" }, "good");
      let done = 0, go;
      const first = one.busy(() => new Promise((end) => (done += 1, go = end)));
      const during = [one.disabled, one.getAttribute("aria-busy")];
      await one.busy(() => (done += 1));
      go();
      await first;
      const after = [one.disabled, one.getAttribute("aria-busy")];
      await one.busy(() => Promise.reject(new Error("x"))).catch(() => 0);
      const failed = [one.disabled, one.getAttribute("aria-busy")];
      const entry = dom.h("input"), other = dom.h("input", { id: "mine" });
      const field = dom.field("Rate", entry, "in Hz"), second = dom.field("Name", other);
      const drawn = (name) => dom.icon(name).querySelector("path").getAttribute("d");
      const named = field.querySelector("label").htmlFor === entry.id && entry.id !== "";
      const hint = field.querySelector(`#${entry.getAttribute("aria-describedby")}`).textContent;
      return [during, done, after, failed, one.type, named, hint, other.id, other.getAttribute("aria-describedby"),
        drawn("unheard of") === drawn("ask"), dom.icon("good").getAttribute("aria-hidden")];
    """
    assert stage.run(script) == [
        [True, "true"], 1, [False, NONE], [False, NONE], "button", True, "in Hz", "mine", NONE, True, "true",
    ]  # fmt: skip


def test_errors_stay_until_they_are_closed_and_success_goes(stage: Stage) -> None:
    stage.run("dom.toast('bad', 'wrong', 'cure'); dom.toast('good', 'fine')")
    look = """return [...document.querySelectorAll('.toast')]
      .map((one) => [one.getAttribute('role'), one.innerText.split('\\n')[0]]);"""
    assert stage.run(look) == [["alert", "wrong"], ["status", "fine"]]
    stage.pass_time(5990)
    assert len(stage.run(look)) == 2
    stage.pass_time(20)
    assert stage.run(look) == [["alert", "wrong"]]
    stage.page.get_by_role("button", name="Close message").click()
    assert stage.run(look) == []
    stage.run("for (const name of '12345') dom.toast('bad', name)")
    assert [words for _, words in stage.run(look)] == ["2", "3", "4", "5"], "the newest four"
