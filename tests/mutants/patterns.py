"""Rules of the profile and of the house, each with the expression that holds it: whoever breaks one must be noticed."""

from __future__ import annotations

from tests.mutants.changes import CPattern, Pattern

PATTERNS = (
    # keys and their life (steps, station, handover)
    Pattern("a pending key out of a backup is no rotation", "_activate", "station.keys.restored(uuid)", "False"),
    Pattern("an imported key that opens is no rotation", "_activate", "record.source == 'agreement'", "True"),
    Pattern(
        "Identify alone makes no node new",
        "_agree_anew",
        "only_new and not agreed.unsigned",
        "False",
        "tests/handover/test_fleet.py",
    ),
    Pattern(
        "a returning node shows that it was reset",
        "_agree_anew",
        "returning and not agreed.unsigned",
        "False",
        "tests/steps/test_pinning.py",
    ),
    Pattern(
        "a lost-out station never agrees by itself",
        "_TakeoverConsent.require",
        "station.keys.held(node.uuid) and not self.rotate",
        "False",
    ),
    Pattern("a takeover needs a word", "_agree", "word.require(station, node)", "None", "tests/handover/test_fleet.py"),
    Pattern(
        "restored: no bus without a word",
        "open_session",
        "station.policy.require_not_restored(node.uuid)",
        "None",
        "tests/handover/test_restored.py",
    ),
    Pattern(
        "given away: no session",
        "open_session",
        "station.policy.require_not_given_away(node.uuid)",
        "None",
        "tests/handover/test_move.py",
    ),
    Pattern(
        "a due rotation is made at contact",
        "session_if_keyed",
        "station.keys.rotates_now(node.uuid)",
        "False",
    ),
    Pattern("only a tap pins", "_pin_for", "node.tapped", "True", "tests/steps/test_agree.py"),
    Pattern(
        "only a new node's bus pins",
        "_pin_for",
        "who.state == NodeState.FACTORY and node.wired",
        "node.wired",
        "tests/steps/test_agree.py",
    ),
    Pattern("a held-back Confirm finds its key", "NodeKeys.outdated", "other.created >= late", "False"),
    Pattern("eight pending keys", "NodeKeys.add_pending", "pending[MAX_PENDING - 1:]", "[]"),
    Pattern(
        "a due rotation makes pending keys imported",
        "NodeKeys.demand_rotation",
        "self._count_as_imported(uuid)",
        "None",
    ),
    Pattern(
        "another board's epoch does not count",
        "Pins.epoch_to_exceed",
        "not same_key(former, pinned)",
        "False",
        "tests/steps/test_agree.py",
    ),
    Pattern(
        "only its receiver hands back",
        "_Judge._obstacle",
        "self.sender != tombstone.to_fingerprint or self.mode != 'move'",
        "False",
    ),
    Pattern("no epoch goes back by a bundle", "_Judge._stale_key", "node.epoch < latest", "False"),
    Pattern(
        "no second key of one epoch",
        "_Judge._stale_key",
        "node.epoch == active",
        "False",
        "tests/handover/test_importing.py",
    ),
    Pattern(
        "a known UUID keeps its key",
        "_Judge._obstacle",
        "pin is not None and (not same_key(pin, fingerprint(node.node_key)))",
        "False",
        "tests/handover/test_importing.py",
    ),
    Pattern(
        "a receipt closes its own move",
        "_delete_what_left",
        "tombstone is None or tombstone.handover_id != row.id",
        "False",
        "tests/handover/test_hostile_stations.py",
    ),
    Pattern("a receipt deletes the key of its bundle", "_delete_what_left", "key.key_id == in_bundle", "True"),
    Pattern("a receipt is for this bundle", "_check_receipt", "receipt.bundle_sha256 not in notes.files", "False"),
    Pattern(
        "after undo a rotation is due",
        "_lift",
        "station.keys.demand_rotation(uuid, f'the move {row.id} did not happen')",
        "None",
    ),
    Pattern(
        "a reset forgets the pending agreement's key", "AgreementSlot.forget", "self._pending.link == link", "False"
    ),
    # the node
    Pattern(
        "a Request dies after 60 s", "AgreementSlot.confirm", "self._clock() - pending.at >= PENDING_SECONDS", "False"
    ),
    Pattern(
        "Confirm comes by its link",
        "AgreementSlot.confirm",
        "pending.link != origin.link",
        "False",
        "tests/protocol/test_tim_agreement.py",
    ),
    Pattern("Confirm comes in its session", "AgreementSlot.confirm", "pending.session is not origin.session", "False"),
    Pattern(
        "the node keeps one CA", "AgreementSlot.request", "flash.ca is not None and request.ca != flash.ca", "False"
    ),
    Pattern(
        "a sequence grows",
        "verified_commit",
        "0 < ahead <= datasheet.SEQUENCE_WINDOW",
        "ahead <= datasheet.SEQUENCE_WINDOW",
    ),
    Pattern(
        "a sequence grows by 65,536 at most", "verified_commit", "0 < ahead <= datasheet.SEQUENCE_WINDOW", "0 < ahead"
    ),
    Pattern("a datasheet is for this epoch", "verified_commit", "signed.key_epoch == flash.epoch", "True"),
    Pattern("every staged image is listed", "_listed_blocks", "staged.keys() - {SECURITY} <= blocks.keys()", "True"),
    Pattern(
        "what flash reads back as something else does not count",
        "Tim._commit",
        "self.memory.load() != state",
        "False",
        "tests/protocol/test_tim_states.py",
    ),
    Pattern(
        "a virtual flash is read back before it is replaced",
        "_replace",
        "file.read() != octets",
        "False",
        "tests/node/test_flash_file.py",
    ),
    Pattern(
        "a virtual flash is replaced whole",
        "_replace",
        "whole_file(path, replace=True)",
        "open(path, 'w+b')",
        "tests/node/test_flash_file.py",
    ),
    Pattern(
        "the shortest dead-man limits a Drive message",
        "StreamRole._in_time",
        "min((self._claims.actuators[channel].dead_man for channel in channels))",
        "self._claims.actuators[channels[0]].dead_man",
        "tests/protocol/operation/test_driving.py",
    ),
    Pattern(
        "a lower counter is a replay",
        "Sessions.open_frame",
        "counter <= session.counter",
        "counter == session.counter",
        "tests/protocol/test_tim_states.py",
    ),
    # links
    Pattern("TNEP waits before the first read", "Poller._exchange", "self._sleep(min(t_wait, patience))", "None"),
    Pattern("STmin of F1 to F9", "gap_seconds", "241 <= octet <= 249", "False", "tests/links/can/test_can_isotp.py"),
    Pattern(
        "a torn sequence ends a message",
        "Reassembly.add_frame",
        "data[0] & 15 != self.number + 1 & 15",
        "False",
        "tests/links/can/test_can_isotp.py",
    ),
    Pattern(
        "a message comes as a whole within 5 s",
        "Pair.run",
        "self.receiving and self._clock() >= self._whole_by",
        "False",
        "tests/links/can/test_can_isotp.py",
    ),
    Pattern(
        "forged Announces move a node less and less",
        "AddressClaim.handle_announce",
        "self._moves < MOVES_AT_ONCE",
        "True",
        "tests/protocol/test_announce.py",
    ),
    Pattern(
        "a question to everyone costs no reply",
        "CanServer._end_answer_to_everyone",
        "line.replying is not pair",
        "True",
        "tests/node/test_can_server.py",
    ),
    # verdicts
    Pattern("an epoch seen before", "_epoch", "shown.key_epoch >= known.key_epoch", "True"),
    Pattern("a sequence seen before", "_sequence", "shown.sequence >= known.sequence", "True"),
    Pattern("an epoch of the future", "_epoch", "shown.key_epoch > known.identity.epoch", "False"),
    Pattern(
        "only good signatures are floors", "freshness_floor_of", "datasheet.signature_good(shown, octets, uuid)", "True"
    ),
    Pattern("no session, no verdict", "Verification.verdict", "_SESSION in failed", "False"),
    Pattern(
        "write refuses another epoch",
        "_require_newer",
        "signed.key_epoch != identity.epoch",
        "False",
        "tests/steps/test_verify.py",
    ),
    Pattern(
        "write asks before a jump",
        "_require_newer",
        "signed.sequence > identity.sequence + SEQUENCE_WINDOW and (not jump)",
        "False",
    ),
    Pattern(
        "an image's sequence is hearsay",
        "_last_known",
        "highest and brought.sequence > highest + SEQUENCE_WINDOW",
        "False",
        "tests/handover/test_fleet.py",
    ),
    Pattern(
        "a signature is used again for a newer number only",
        "sign",
        "number > node_sequence",
        "True",
        "tests/steps/test_verify.py",
    ),
    # the plant
    Pattern(
        "another holder's turn is waited for",
        "NodeKeys.rotates_now",
        "why is None or not why.startswith(_FROM)",
        "True",
        "tests/plant/test_leaving.py",
    ),
    Pattern(
        "a key that no removed station had ends the mark",
        "_activate",
        "station.keys.end_removal_mark(record)",
        "None",
        "tests/plant/test_leaving.py",
    ),
    Pattern(
        "a parcel of a removed station raises no alarm",
        "_Reader._junk",
        "self._is_from_removed(parcel)",
        "False",
        "tests/plant/test_parcels.py",
    ),
    Pattern(
        "evidence names the epoch of its datasheet",
        "_wrong_datasheet",
        "(shown.sequence, shown.key_epoch) != (facts.sequence, facts.epoch)",
        "shown.sequence != facts.sequence",
        "tests/plant/test_evidence.py",
    ),
    Pattern(
        "evidence names the content of each block",
        "_wrong_datasheet",
        "blocks_of(shown) != facts.blocks",
        "len(blocks_of(shown)) != len(facts.blocks)",
        "tests/plant/test_evidence.py",
    ),
    # measuring and the service
    Pattern(
        "a node that was moved is measured no more",
        "require_measurable",
        "station.policy.require_not_given_away(uuid)",
        "None",
        "tests/measure/test_standing.py",
    ),
    Pattern(
        "off the whitelist nothing moves",
        "NodeStanding._require_today",
        "require_whitelisted(station, uuid)",
        "None",
    ),
    Pattern(
        "a value of set is abandoned at the dead-man",
        "HeldActuator.apply",
        "time.monotonic() - began > self._dead_man / 1000",
        "False",
        "tests/measure/test_held_actuator.py",
    ),
    Pattern(
        "set reports that its node did not confirm",
        "HeldActuator.require_confirmation",
        "self.safe is None",
        "False",
        "tests/measure/test_held_actuator.py",
    ),
    Pattern("a set point grows old", "TopicActuators._seconds_left", "age > self._dead_man / 1000", "False"),
    Pattern("a set point grows old in the queue", "TopicActuators._send", "self._seconds_left(command)", "None"),
    Pattern("a browser's token ends", "Tokens.find", "known_token.until > now", "True"),
    Pattern("a login link ends", "Tokens.login", "until < time.monotonic()", "False"),
    Pattern(
        "a login link works once",
        "Tokens.login",
        "self._logins.pop(digest_of(token), (0.0, False))",
        "self._logins.get(digest_of(token), (0.0, False))",
    ),
    # one change each that no test noticed on 2026-11-24
    Pattern(
        "a broker keeps the will",
        "MqttSink._prepare",
        "client.will_set(self._status, 'offline', qos=1, retain=True)",
        "client.will_set(self._status, 'offline', qos=1)",
        "tests/measure/sinks/test_mqtt.py",
    ),
    Pattern(
        "the last chunk is marked",
        "_nonce",
        "b'\\x01' if last else b'\\x00'",
        "b'\\x00'",
        "tests/backup/test_backup_rows.py",
    ),
    Pattern(
        "a node's lock is of the open file",
        "_LockedOctet._try_to_lock",
        "fcntl.F_OFD_SETLK",
        "fcntl.F_SETLK",
        "tests/station/test_lock.py",
    ),
    Pattern(
        "a job's end that was seen counts",
        "require_open",
        "max(now, job.ends) if seen else now",
        "now",
        "tests/plant/test_jobs.py",
    ),
    Pattern(
        "a job's count is checked again", "_require_room", "given >= job.total", "False", "tests/plant/test_office.py"
    ),
    # wrapped sensors (node/wrapped)
    Pattern(
        "a late value of a wrapped sensor is invalid",
        "LatestValues.at",
        "moment - arrival.at > self._longest and time.monotonic() - arrival.at > self._longest + _UNREAD",
        "False",
        "tests/node/test_wrapped_dbc.py",
    ),
    Pattern(
        "a value outside its signal's range is invalid",
        "LatestValues._outside",
        "self._low <= value <= self._high",
        "True",
        "tests/node/test_wrapped_dbc.py",
    ),
    Pattern(
        "a wrapped node runs from the file that it was made from",
        "_require_same",
        "sensor.origin != origin",
        "False",
        "tests/node/test_wrapped_dbc.py",
    ),
    Pattern(
        "the origin in evidence is the one that was signed",
        "_wrong_datasheet",
        "facts.origin is not None and not _is_listed(facts.origin, shown)",
        "False",
        "tests/plant/test_evidence.py",
    ),
)

_C_TESTS = "tests/firmware/test_c_tests.py"
_IN_ONE_PROCESS = "tests/firmware/test_protocol_suites.py"

C_PATTERNS = (
    CPattern(
        "a slot is read back before it counts",
        "teds_store.c",
        "crc_good(port, into.area, total, &good) == 0 && good;",
        "crc_good(port, into.area, total, &good) == 0;",
        _IN_ONE_PROCESS,
    ),
    CPattern(
        "an identity is read back before it counts",
        "teds_store.c",
        "return failed || good ? failed : TEDS_E_FLASH;",
        "return failed;",
        "tests/firmware/test_flash_reads.py",
    ),
    CPattern(
        "the shortest dead-man limits a Drive message",
        "drive.c",
        "i < session->drive.count; i++) {\n        if (ahead >",
        "i < 1; i++) {\n        if (ahead >",
        "tests/firmware/test_operation_suites.py",
    ),
    CPattern("STmin of F1 to F9", "isotp.c", "if (stmin >= 0xF1 && stmin <= 0xF9) {", "if (0) {", _C_TESTS),
    CPattern("a lower counter is a replay", "session.c", "taken->counter <= last", "taken->counter == last", _C_TESTS),
)
