"""The numbers of docs/contract/cli.md and docs/contract/api.md, and of the guides, as literals."""

from __future__ import annotations

from datetime import timedelta

from teds_provision import client, firmware_image
from teds_provision.api import bodies, operations
from teds_provision.backup import chunks, sealed_file
from teds_provision.cli.measure.record import SHOWN
from teds_provision.doctor import fleet, machine, report
from teds_provision.doctor import station as doctor_station
from teds_provision.handover import outgoing, trust
from teds_provision.limits import LIMITS
from teds_provision.links import ports
from teds_provision.links.ble import airtime
from teds_provision.links.can import spec, transfer_pace
from teds_provision.measure import (
    background_reread,
    clock,
    grid,
    planning,
    sample_series,
    standing,
    stream_receiver,
    topic_actuators,
    verified_session,
    zero,
)
from teds_provision.measure import sampling as one_sample
from teds_provision.measure.held_actuator import LONGEST_PAUSE
from teds_provision.measure.recordings import source
from teds_provision.measure.running import common_start, measurement, streams
from teds_provision.measure.sinks import base, files, foxglove_server, mqtt
from teds_provision.measure.sinks.mcap import recording
from teds_provision.measure.sinks.ros import child, rclpy_child, ros1_child, ros2
from teds_provision.ncap import history, live, membership, waits
from teds_provision.ncap.nodes import actuator_leases, simulation
from teds_provision.ncap.web import app, guard, tokens
from teds_provision.node.wrapped import description
from teds_provision.protocol import announce, datasheet, fingerprints, repetition
from teds_provision.protocol.handover import bundle, jose, revocation, strict_json
from teds_provision.protocol.messages import firmware
from teds_provision.protocol.operation import budget
from teds_provision.provisioning import batch_sheet, image_manager, update, whitelist
from teds_provision.station import datasheets, groups, label, node_keys, pins, policy, row_macs
from teds_provision.station import nodes as known_nodes
from teds_provision.station.store import connection, lock, row_sample, schema
from teds_provision.teds import channel, curve
from teds_provision.teds.calibration import files as calibration_files
from teds_provision.teds.calibration.model import MAXIMUM_INPUTS
from teds_provision.teds.codec import decode
from teds_provision.vault import agent, ca_file, master, passphrase, pkcs11


def test_the_numbers_of_the_contract() -> None:
    """Other tests reach these limits by the names of the constants: here they are what the contract says."""
    numbers: dict[str, tuple[object, object]] = {
        "a UUID is known by four digits": (known_nodes._MIN_PREFIX, 4),
        "a fingerprint has 64 digits, 32 of them count": ((fingerprints.DIGITS, fingerprints.LEAST_DIGITS), (64, 32)),
        "a label begins with TEDS1": (label.PREFIX, "TEDS1"),
        "no group is called all": ((groups.ALL, groups.LONGEST), ("all", 64)),
        "identify listens for three seconds at least": (ports.LISTEN_SECONDS, 3.0),
        "bit rates that are assumed": ((spec.DEFAULT_BITRATE, spec.DEFAULT_DATA_BITRATE), (500_000, 2_000_000)),
        "addresses of stations and nodes": (
            (spec.FIRST_STATION, spec.LAST_STATION, spec.LAST_NODE, announce.LAST_ADDRESS), (0xF1, 0xF7, 0xEF, 239)
        ),
        "identifier of Announce": (announce.ANNOUNCE, 0x1CFF0000),
        "a board blinks for a minute at most": (firmware.LOCATE_SECONDS, 60),
        "an image names its board": (firmware_image.BOARD_TLV, 0x54A0),
        "a restarted board has 180 s": (update.WAIT_SECONDS, 180.0),
        "three offsets that do not grow": (image_manager._STUCK, 3),
        "packets leave a tenth of a bus": (transfer_pace._MOST, 0.9),
        "results of an update": (update.RESULTS, ("updated", "already", "reverted", "refused", "lost")),
        "leases grow with the bus": (
            (verified_session.LEASE, verified_session.LEASE_EACH, verified_session.LONGEST_LEASE), (10, 0.2, 60)
        ),
        "an actuator is fed every half second at least": (LONGEST_PAUSE, 0.5),
        "a set point has a dead-man of a second": (verified_session.DEAD_MAN, 1000),
        "a zero is the mean of 16 samples at least": ((sample_series.SAMPLES, zero._AFTERWARDS), (32, 16)),
        "one reading claims for seconds": (one_sample.LEASE, 5),
        "what a full turn is": ((channel._NEARLY_A_TURN, channel.TURN), (1e-5, 6.283185307179586)),
        "data take a part of the bus": (budget.MOST_LOAD, 0.6),
        "today's verdict within two seconds": (
            (standing.SETTLING, waits.USUAL.selection, waits.USUAL.store, waits.USUAL.token), (0.5, 2.0, 1.0, 1.0)
        ),
        "the rest is read in what data leave free": ((background_reread.GAP, background_reread.SPARING), (1, 4.0)),
        "a command waits five seconds for a node": (client.LETTING_GO, 5.0),
        "why a newcomer waits": ((membership.NO_ROOM, membership.AGAIN), ("no room on the bus", 30.0)),
        "a sheet": ((batch_sheet.MAX_ROWS, batch_sheet._LEAST_DIGITS), (10_000, 32)),
        "columns of a sheet": (
            batch_sheet.COLUMNS, ("uuid", "name", "profile", "calibration", "item", "fingerprint")
        ),
        "a wrapped value is too old after three periods": (description.PERIODS_LATE, 3),
        "a vault is held open for twelve hours at most": (agent.MOST_SECONDS, 43_200),
        "values that record show gives": (SHOWN, 20),
        "Foxglove on this machine": (foxglove_server.USUAL, "127.0.0.1:8765"),
        "rows and messages to topics": ((base.ROWS, base.BUDGET), (1000, 5000)),
        # docs/contract/api.md
        "a body": ((guard.LARGEST_BODY, operations.LARGEST_IMAGE), (1_048_576, 4_194_304)),
        "ten wrong tokens in a minute": ((guard._WRONG_TOKENS, guard._WRONG_WITHIN), (10, 60.0)),
        "a login and a browser": ((tokens.LOGIN_SECONDS, tokens.BROWSER_SECONDS), (300.0, 2_592_000.0)),
        "what one answer holds": (
            (operations.MOST_NODES, operations.MOST_ENTRIES, operations.MOST_POINTS), (1000, 10_000, 3600)
        ),
        "an update": ((operations.MOST_AT_ONCE, operations.LONGEST_WAIT), (24, 3600)),
        "a set point is held": ((actuator_leases.HOLD, bodies.LONGEST_HOLD), (1.0, 60.0)),
        "points a second of a live channel": (live.POINTS, 100.0),
        "the past": ((history.HOUR, history.MINUTE, history.FINE), (3600, 60, 0.01)),
        "a simulation feeds 1 MiB/s": (simulation.MOST_OCTETS, 1_048_576),
        "places of /live": ((app.MOST_LISTENERS, app.OF_ONE_TOKEN), (200, 100)),
    }  # fmt: skip
    assert {what: one for what, (one, _) in numbers.items()} == {what: due for what, (_, due) in numbers.items()}


def test_the_numbers_of_the_guides() -> None:
    numbers: dict[str, tuple[object, object]] = {
        # docs/batch.md
        "what each link bears": (
            (ports.NFC, ports.CAN, ports.BLE),
            (
                ports.Capabilities(True, False, False, False, False, False, False, 1, 2000),
                ports.Capabilities(False, True, True, True, True, True, True, 24, 24_000),
                ports.Capabilities(False, False, True, False, False, False, True, 1, 8000),
            ),
        ),
        # docs/recording.md
        "a part has 1 GiB": (files.LARGEST_PART, 1_073_741_824),
        "values are in the file, then on the disk": ((files.FLUSH, files.SYNC), (0.1, 1.0)),
        "a full disk needs 1 MiB": ((files.ROOM, files.AGAIN), (1_048_576, 1.0)),
        "chunks of an MCAP": (recording.CHUNK_OCTETS, 65_536),
        "a value of a row is no older than two periods": (grid.PERIODS_OF_A_VALUE, 2.0),
        "what is read of a recording": (
            (source.MOST.line, source.MOST.chunk, source.MOST.channels), (8_388_608, 67_108_864, 20_000)
        ),
        # docs/measuring.md
        "readings of a clock at the start": (clock.AT_FIRST, 5),
        "a node is silent": (streams.SILENT, 2.0),
        "the last message is waited for": (stream_receiver.HEARD_OUT, 0.25),
        "a message holds 20 ms; 10 Hz if nothing is stated": (
            (planning.BLOCK, planning.UNSTATED), (20_000_000, 100_000_000)
        ),
        "messages of a Bluetooth adapter": (airtime.AIR_MESSAGES, 160.0),
        "others start without a busy node": (common_start.WAITING, 2.0),
        "values that wait for a recorder": (base.RECORDER_WAITING, 2_000_000),
        "set points that go as Drive": (topic_actuators.DRIVE_ABOVE, 50),
        # docs/ros.md
        "rows leave, and a master is missed": ((measurement.BEAT, measurement.WAITING), (0.02, 3.0)),
        "subscribers are waited for": (ros1_child.MEETING, 1.0),
        "a child is started again": (child.BACK_OFF, (1.0, 30.0)),
        "a reader of DDS may lag behind": ((ros2.HISTORY, rclpy_child.HISTORY), (100, 100)),
        "a file of a broker's URL": (mqtt._MOST_OCTETS, 1_048_576),
        # docs/formats.md
        "a file of TEDS": (
            (LIMITS.teds_file, LIMITS.teds_of_a_file, decode.MAX_OCTETS, decode.MAX_TUPLES),
            (33_554_432, 2000, 16_777_216, 32_768),
        ),
        "JSON": ((LIMITS.json_values, LIMITS.json_depth, LIMITS.integer_digits), (2_000_000, 32, 1000)),
        "XML": ((LIMITS.xml_elements, LIMITS.xml_attributes, LIMITS.xml_depth), (200_000, 400_000, 32)),
        "a certificate": (
            (LIMITS.certificate, LIMITS.certificate_tables, LIMITS.certificate_pairs, LIMITS.certificate_values),
            (8_388_608, 200, 1000, 10_000),
        ),
        "Intel HEX": ((LIMITS.hex_records, LIMITS.hex_stretches), (2_500_000, 2000)),
        "TOML": (
            (LIMITS.text_file, LIMITS.toml_keys, LIMITS.toml_parts, LIMITS.toml_depth), (1_048_576, 20_000, 32, 16)
        ),
        "a calibration": (
            (calibration_files.MAXIMUM_ROWS, calibration_files._LINE, MAXIMUM_INPUTS, curve.TERMS),
            (200_000, 20_000, 8, 50_000_000),
        ),
        "a unit and an expression": ((LIMITS.unit, LIMITS.expression, LIMITS.terms), (64, 1000, 16)),
        "a whitelist": (
            (whitelist.MAX_FILE_OCTETS, whitelist.MAX_ENTRIES, whitelist._MAX_DEPTH, whitelist._MOST_TAGS,
             whitelist._MOST_LINES, whitelist._MAX_TAG),
            (67_108_864, 250_000, 16, 3_000_000, 1_000_000, 65_536),
        ),
    }  # fmt: skip
    assert {what: one for what, (one, _) in numbers.items()} == {what: due for what, (_, due) in numbers.items()}


def test_the_numbers_of_stores_vaults_and_handovers() -> None:
    numbers: dict[str, tuple[object, object]] = {
        # docs/store.md
        "a check reads a sample": ((row_sample.SAMPLED, row_sample._NEWEST, row_sample._RUN), (5000, 500, 20)),
        "keys that wait for their proof": (node_keys.MAX_PENDING, 8),
        "a Confirm may be late": (node_keys.CONFIRM_MAY_ARRIVE, timedelta(minutes=2)),
        "the present datasheet and ten older ones": (datasheets.KEPT, 11),
        "a MAC of a row": ((row_macs.MAC_OCTETS, row_macs.KEY_OCTETS), (16, 32)),
        "one wrong key of a UUID is recorded in ten minutes": (pins.RECORD_AGAIN, 600.0),
        "who waits for the store, and for a node": ((connection.BUSY_SECONDS, lock._TURN_SECONDS), (10.0, 60.0)),
        "a store": ((schema.APPLICATION_ID, schema.OLDEST_SCHEMA), (0x54454453, 7)),
        "a backup": ((sealed_file.MAX_OCTETS, chunks.CHUNK_OCTETS), (17_179_869_184, 1_048_576)),
        "a backup gets old": (doctor_station._BACKUP_DAYS, 90),
        "how many names a check shows": ((policy._SHOWN, fleet._SHOWN), (5, 5)),
        "the last errors of a report": (report._LAST_ERRORS, 20),
        "years that a clock may show": ((machine._FIRST_YEAR, machine._LAST_YEAR), (2025, 2099)),
        # docs/security.md
        "Argon2id": (
            (passphrase.PRODUCT.memory_kib, passphrase.PRODUCT.iterations, passphrase.PRODUCT.lanes), (65_536, 3, 4)
        ),
        "what a forged vault may cost": (
            (passphrase._MAX_MEMORY_KIB, passphrase._MAX_WORK_KIB, passphrase._MAX_LANES), (196_608, 2_097_152, 16)
        ),
        "a passphrase": ((passphrase.MIN_CHARACTERS, passphrase.MAX_OCTETS), (8, 1024)),
        "PBKDF2 of an exported CA key": ((ca_file.ROUNDS, ca_file.MAX_ROUNDS), (600_000, 10_000_000)),
        "master and wrapped keys": ((master.MASTER_OCTETS, master._VERSION), (32, 1)),
        "who waits for a token": (pkcs11._WAIT_SECONDS, 30.0),
        "the secret of an agent": (agent.MOST_OCTETS, 1024),
        # docs/handover.md, docs/profile.md
        "a bundle": (
            (outgoing.DEFAULT_DAYS, outgoing.NODES_IN_A_BUNDLE, bundle.MAX_BUNDLE_OCTETS, jose.MAX_RECIPIENTS),
            (7, 50_000, 67_108_864, 256),
        ),
        "a sender's clock may be ahead": (bundle.CLOCK_TOLERANCE, timedelta(minutes=10)),
        "a text in a bundle": (strict_json._MAX_TEXT, 1024),
        "a statement, a request, a key file": (
            (revocation.MAX_OCTETS, trust.MAX_OCTETS, trust.MAX_KEY_FILE), (16_384, 16_384, 65_536)
        ),
        "digits of a trusted key": ((trust._MIN_PREFIX, policy._MIN_FINGERPRINT_PREFIX), (8, 16)),
        "the next sequence": (datasheet.SEQUENCE_WINDOW, 65_536),
        "TEDS that a node stores": (
            (sorted(datasheet.STORED_CODES), datasheet.LAST_CHANNEL), ([*range(1, 18), *range(128, 136)], 255)
        ),
        "a reply is repeated": (repetition.KEEP_SECONDS, 20.0),
    }  # fmt: skip
    assert {what: one for what, (one, _) in numbers.items()} == {what: due for what, (_, due) in numbers.items()}
