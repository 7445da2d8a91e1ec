"""The tables of ``store.sqlite3``.

``PRAGMA application_id`` marks the file as ours, ``PRAGMA user_version`` gives the schema. A store of a newer one, or
of one before KeyAgreement 2, is refused and never guessed at; one in between is brought forward, version by version, in
one transaction.
"""

from __future__ import annotations

from typing import Final

APPLICATION_ID: Final = 0x54454453  # "TEDS"
SCHEMA_VERSION: Final = 15
OLDEST_SCHEMA: Final = 7
"""The first of KeyAgreement 2. Link keys of older stores were agreed as no node does any more."""

# Schema 7, complete. MAC columns (16 octets) protect the rows that decide whom the station trusts.
_TABLES: Final = (
    "CREATE TABLE meta(name TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT, WITHOUT ROWID",
    # -- the station itself; taken_over is no longer written, but backups have it
    """CREATE TABLE station(
        one INTEGER PRIMARY KEY CHECK(one = 1), name TEXT NOT NULL CHECK(name <> ''),
        keystore TEXT NOT NULL CHECK(keystore IN ('keyring', 'file') OR keystore GLOB 'pkcs11:*'),
        keystore_why TEXT NOT NULL, requested BLOB CHECK(length(requested) = 65),
        point BLOB CHECK(length(point) = 65), ca BLOB CHECK(length(ca) = 65),
        signature BLOB CHECK(length(signature) = 64), master INTEGER NOT NULL DEFAULT 1 CHECK(master > 0),
        rewrapping INTEGER CHECK(rewrapping > 0), seal_key BLOB, taken_over TEXT, mac BLOB CHECK(length(mac) = 16),
        CHECK((point IS NULL) = (ca IS NULL) AND (point IS NULL) = (signature IS NULL))) STRICT""",
    """CREATE TABLE certificates(
        ca TEXT NOT NULL CHECK(length(ca) = 64), station TEXT NOT NULL CHECK(length(station) = 64),
        signature BLOB NOT NULL CHECK(length(signature) = 64), PRIMARY KEY(ca, station)) STRICT, WITHOUT ROWID""",
    # -- nodes and their keys
    """CREATE TABLE whitelist(
        uuid BLOB PRIMARY KEY CHECK(length(uuid) = 10), fingerprint TEXT, added TEXT NOT NULL, assurance TEXT NOT NULL,
        name TEXT, mac BLOB CHECK(length(mac) = 16)) STRICT, WITHOUT ROWID""",
    "CREATE INDEX whitelist_by_name ON whitelist(name) WHERE name IS NOT NULL",
    """CREATE TABLE nodes(
        uuid BLOB PRIMARY KEY CHECK(length(uuid) = 10), point BLOB CHECK(point IS NULL OR length(point) = 65),
        name TEXT, profile TEXT, state INTEGER NOT NULL, epoch INTEGER NOT NULL, sequence INTEGER NOT NULL,
        can_address INTEGER NOT NULL, groups TEXT NOT NULL, teds_sha256 TEXT, retired TEXT, last_seen TEXT,
        channels INTEGER NOT NULL, point_mac BLOB CHECK(length(point_mac) = 16), due TEXT CHECK(length(due) = 10),
        charging TEXT) STRICT, WITHOUT ROWID""",
    "CREATE INDEX nodes_by_name ON nodes(name) WHERE name IS NOT NULL",
    "CREATE INDEX nodes_by_due ON nodes(due) WHERE due IS NOT NULL",
    """CREATE TABLE marks(
        uuid BLOB PRIMARY KEY CHECK(length(uuid) = 10), ca BLOB CHECK(length(ca) = 65),
        ca_mac BLOB CHECK(length(ca_mac) = 16), next_key_id TEXT CHECK(length(next_key_id) = 16),
        next_ca BLOB CHECK(length(next_ca) = 65), rotation TEXT CHECK(rotation <> ''),
        former TEXT CHECK(length(former) = 64), CHECK((next_key_id IS NULL) = (next_ca IS NULL)))
        STRICT, WITHOUT ROWID""",
    """CREATE TABLE keys(
        seq INTEGER PRIMARY KEY AUTOINCREMENT, uuid BLOB NOT NULL CHECK(length(uuid) = 10), epoch INTEGER NOT NULL,
        key_id TEXT NOT NULL CHECK(length(key_id) = 16), state TEXT NOT NULL CHECK(state IN ('pending', 'active')),
        slot INTEGER NOT NULL, wrapped BLOB NOT NULL, source TEXT NOT NULL, created TEXT NOT NULL,
        UNIQUE(uuid, key_id), UNIQUE(uuid, epoch, slot)) STRICT""",
    "CREATE UNIQUE INDEX one_active_key ON keys(uuid) WHERE state = 'active'",
    "CREATE TABLE key_slots(uuid BLOB PRIMARY KEY, last INTEGER NOT NULL) STRICT, WITHOUT ROWID",
    # -- drafts, datasheets, and the one reading per node that verdicts are computed from
    """CREATE TABLE drafts(
        uuid BLOB PRIMARY KEY CHECK(length(uuid) = 10), blocks BLOB NOT NULL,
        stage TEXT NOT NULL CHECK(stage IN ('built', 'signed')), profile TEXT, created TEXT NOT NULL)
        STRICT, WITHOUT ROWID""",
    """CREATE TABLE datasheets(
        row INTEGER PRIMARY KEY, uuid BLOB NOT NULL CHECK(length(uuid) = 10), sequence INTEGER NOT NULL,
        epoch INTEGER NOT NULL, signed TEXT, profile TEXT, seen TEXT NOT NULL, digest BLOB NOT NULL
        CHECK(length(digest) = 32), blocks BLOB NOT NULL) STRICT""",
    "CREATE INDEX datasheets_of_node ON datasheets(uuid)",
    """CREATE TABLE readings(
        uuid BLOB PRIMARY KEY CHECK(length(uuid) = 10), at TEXT NOT NULL, by TEXT NOT NULL,
        c BLOB CHECK(length(c) = 8), whole INTEGER NOT NULL CHECK(whole IN (0, 1)), digests BLOB NOT NULL,
        node_key BLOB CHECK(length(node_key) = 65), node_key_signature BLOB CHECK(length(node_key_signature) = 64),
        station_key BLOB CHECK(length(station_key) = 65),
        station_key_signature BLOB CHECK(length(station_key_signature) = 64), checks TEXT NOT NULL)
        STRICT, WITHOUT ROWID""",
    # -- other stations
    """CREATE TABLE trust(
        name TEXT PRIMARY KEY, role TEXT NOT NULL CHECK(role IN ('station', 'ca')),
        point BLOB NOT NULL CHECK(length(point) = 65), fingerprint TEXT NOT NULL CHECK(length(fingerprint) = 64),
        added TEXT NOT NULL, mac BLOB CHECK(length(mac) = 16), UNIQUE(fingerprint, role)) STRICT, WITHOUT ROWID""",
    """CREATE TABLE handovers(
        id TEXT NOT NULL, direction TEXT NOT NULL CHECK(direction IN ('out', 'in')),
        mode TEXT NOT NULL CHECK(mode IN ('copy', 'move')), peers TEXT NOT NULL, state TEXT NOT NULL,
        nodes TEXT NOT NULL, bundle_sha256 TEXT, receipt TEXT, created TEXT NOT NULL, PRIMARY KEY(id, direction))
        STRICT, WITHOUT ROWID""",
    """CREATE TABLE tombstones(
        uuid BLOB PRIMARY KEY CHECK(length(uuid) = 10), to_fingerprint TEXT NOT NULL, handover_id TEXT NOT NULL,
        created TEXT NOT NULL) STRICT, WITHOUT ROWID""",
    """CREATE TABLE holders(
        uuid BLOB NOT NULL CHECK(length(uuid) = 10), fingerprint TEXT NOT NULL, since TEXT NOT NULL,
        mode TEXT NOT NULL, PRIMARY KEY(uuid, fingerprint)) STRICT, WITHOUT ROWID""",
    """CREATE TABLE revocations(
        uuid BLOB PRIMARY KEY CHECK(length(uuid) = 10), fingerprint TEXT, why TEXT NOT NULL, statement TEXT NOT NULL,
        created TEXT NOT NULL) STRICT, WITHOUT ROWID""",
    """CREATE TABLE lifted(
        statement TEXT PRIMARY KEY CHECK(length(statement) = 64), at TEXT NOT NULL,
        mac BLOB CHECK(length(mac) = 16)) STRICT, WITHOUT ROWID""",
    """CREATE TABLE ended_cas(
        ca TEXT PRIMARY KEY CHECK(length(ca) = 64), at TEXT NOT NULL, mac BLOB CHECK(length(mac) = 16))
        STRICT, WITHOUT ROWID""",
    # -- measuring
    """CREATE TABLE groups(
        name TEXT PRIMARY KEY CHECK(length(name) BETWEEN 1 AND 100), created TEXT NOT NULL) STRICT, WITHOUT ROWID""",
    """CREATE TABLE group_members(
        name TEXT NOT NULL REFERENCES groups(name) ON DELETE CASCADE, uuid BLOB NOT NULL CHECK(length(uuid) = 10),
        PRIMARY KEY(name, uuid)) STRICT, WITHOUT ROWID""",
    """CREATE TABLE measurements(
        id TEXT PRIMARY KEY CHECK(id <> ''), group_name TEXT REFERENCES groups(name) ON DELETE CASCADE,
        uuids TEXT NOT NULL, channels TEXT NOT NULL, rate REAL CHECK(rate > 0),
        kind TEXT CHECK(kind IN ('periodic', 'event', 'free')), trigger INTEGER NOT NULL CHECK(trigger IN (0, 1)),
        actuators INTEGER NOT NULL CHECK(actuators IN (0, 1)),
        dead_man INTEGER NOT NULL CHECK(dead_man BETWEEN 20 AND 10000),
        scalar_rate REAL NOT NULL CHECK(scalar_rate BETWEEN 0 AND 1000), sinks TEXT NOT NULL,
        lasting INTEGER NOT NULL CHECK(lasting IN (0, 1)), ends REAL, created TEXT NOT NULL,
        test_pattern INTEGER NOT NULL DEFAULT 0 CHECK(test_pattern IN (0, 1)),
        unsigned INTEGER NOT NULL DEFAULT 0 CHECK(unsigned IN (0, 1)), require TEXT NOT NULL DEFAULT '',
        CHECK((group_name IS NULL) <> (uuids = '[]'))) STRICT, WITHOUT ROWID""",
    """CREATE TABLE topics(
        uuid BLOB NOT NULL CHECK(length(uuid) = 10), channel INTEGER NOT NULL CHECK(channel BETWEEN 0 AND 255),
        name TEXT NOT NULL UNIQUE CHECK(name <> ''), PRIMARY KEY(uuid, channel)) STRICT, WITHOUT ROWID""",
    """CREATE TABLE detection(
        one INTEGER PRIMARY KEY CHECK(one = 1),
        mode TEXT NOT NULL CHECK(mode IN ('transparent', 'whitelist'))) STRICT""",
    # -- the audit log, which only grows
    """CREATE TABLE audit(
        seq INTEGER PRIMARY KEY, at TEXT NOT NULL, who TEXT NOT NULL, act TEXT NOT NULL, uuid BLOB,
        outcome TEXT NOT NULL, detail TEXT NOT NULL, hash BLOB NOT NULL CHECK(length(hash) = 32)) STRICT""",
    "CREATE INDEX audit_of_node ON audit(uuid) WHERE uuid IS NOT NULL",
    """CREATE TRIGGER audit_is_never_changed BEFORE UPDATE ON audit
        BEGIN SELECT RAISE(ABORT, 'the audit log is append-only'); END""",
    """CREATE TRIGGER audit_is_never_shortened BEFORE DELETE ON audit
        BEGIN SELECT RAISE(ABORT, 'the audit log is append-only'); END""",
    """CREATE TRIGGER audit_only_grows BEFORE INSERT ON audit
        WHEN NEW.seq IS NOT (SELECT coalesce(max(seq), 0) + 1 FROM audit)
        BEGIN SELECT RAISE(ABORT, 'the audit log is append-only'); END""",
)

_NODES_GROUPS: Final = (
    "nodes, json_each(iif(json_valid(nodes.groups), nodes.groups, '[]')) AS each WHERE each.value <> ''"
)
_GROUP_NAME: Final = """CASE WHEN each.value IN ('all', '.', '..') OR length(each.value) > 64 OR trim(each.value) = ''
    OR (length(each.value) >= 4 AND (each.value NOT GLOB '*[^0-9a-fA-F]*'
        OR (each.value GLOB '0x????*' AND substr(each.value, 3) NOT GLOB '*[^0-9a-fA-F]*')))
    THEN rtrim('group ' || substr(each.value, 1, 58)) ELSE each.value END"""

_STEPS_TO: Final[dict[int, tuple[str, ...]]] = {
    # The digest of the profile from which a node's datasheet was built.
    8: ("ALTER TABLE nodes ADD COLUMN profile_digest TEXT",),
    # Measurements that nodes join as they come: a CHECK of the table differs, so the table is rebuilt.
    9: (
        "ALTER TABLE measurements RENAME TO measurements_before",
        """CREATE TABLE measurements(
        id TEXT PRIMARY KEY CHECK(id <> ''), group_name TEXT REFERENCES groups(name) ON DELETE CASCADE,
        uuids TEXT NOT NULL, channels TEXT NOT NULL, rate REAL CHECK(rate > 0),
        kind TEXT CHECK(kind IN ('periodic', 'event', 'free')), trigger INTEGER NOT NULL CHECK(trigger IN (0, 1)),
        actuators INTEGER NOT NULL CHECK(actuators IN (0, 1)),
        dead_man INTEGER NOT NULL CHECK(dead_man BETWEEN 20 AND 10000),
        scalar_rate REAL NOT NULL CHECK(scalar_rate BETWEEN 0 AND 1000), sinks TEXT NOT NULL,
        lasting INTEGER NOT NULL CHECK(lasting IN (0, 1)), ends REAL, created TEXT NOT NULL,
        test_pattern INTEGER NOT NULL DEFAULT 0 CHECK(test_pattern IN (0, 1)),
        unsigned INTEGER NOT NULL DEFAULT 0 CHECK(unsigned IN (0, 1)), require TEXT NOT NULL DEFAULT '',
        match TEXT CHECK(match <> ''), frozen INTEGER NOT NULL DEFAULT 0 CHECK(frozen IN (0, 1)),
        CHECK((group_name IS NOT NULL) + (uuids <> '[]') + (match IS NOT NULL) = 1)) STRICT, WITHOUT ROWID""",
        "INSERT INTO measurements SELECT *, NULL, 0 FROM measurements_before",
        "DROP TABLE measurements_before",
    ),
    # The plant: its stations' statements (contract/plant.md); empty until `registry connect`.
    10: (
        # -- this station's membership; mac columns protect rows
        """CREATE TABLE plant(
        one INTEGER PRIMARY KEY CHECK(one = 1), registry TEXT NOT NULL CHECK(length(registry) = 36),
        joined TEXT NOT NULL, left TEXT, url TEXT, synced TEXT,
        acknowledged INTEGER NOT NULL DEFAULT 0 CHECK(acknowledged >= 0),
        restored TEXT, restored_mac BLOB CHECK(length(restored_mac) = 16), mac BLOB CHECK(length(mac) = 16)) STRICT""",
        """CREATE TABLE rosters(
        version INTEGER NOT NULL CHECK(version > 0), hash TEXT NOT NULL CHECK(length(hash) = 64),
        octets BLOB NOT NULL, held INTEGER NOT NULL CHECK(held IN (0, 1)), at TEXT NOT NULL,
        mac BLOB CHECK(length(mac) = 16), PRIMARY KEY(version, hash)) STRICT, WITHOUT ROWID""",
        "CREATE UNIQUE INDEX one_roster ON rosters(held) WHERE held = 1",
        """CREATE TABLE alarms(
        code TEXT NOT NULL, about TEXT NOT NULL, n INTEGER NOT NULL, why TEXT NOT NULL, at TEXT NOT NULL,
        seen INTEGER NOT NULL DEFAULT 0 CHECK(seen IN (0, 1)), PRIMARY KEY(code, about, n)) STRICT, WITHOUT ROWID""",
        # -- events of this station that wait for a page, and the pages of all stations, including its own
        """CREATE TABLE outbox(
        seq INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT NOT NULL UNIQUE CHECK(length(id) = 16),
        event TEXT NOT NULL) STRICT""",
        """CREATE TABLE chains(
        chain INTEGER PRIMARY KEY, station TEXT NOT NULL UNIQUE CHECK(length(station) = 64),
        counted INTEGER NOT NULL DEFAULT 0, counted_hash TEXT NOT NULL DEFAULT '',
        folded INTEGER NOT NULL DEFAULT 0, folded_hash TEXT NOT NULL DEFAULT '',
        accepted INTEGER, accepted_hash TEXT, waits TEXT) STRICT""",
        """CREATE TABLE pages(
        chain INTEGER NOT NULL REFERENCES chains(chain), n INTEGER NOT NULL CHECK(n > 0),
        hash TEXT NOT NULL CHECK(length(hash) = 64), previous TEXT NOT NULL, created TEXT NOT NULL, home TEXT NOT NULL,
        header BLOB NOT NULL, content BLOB NOT NULL, signature BLOB NOT NULL CHECK(length(signature) = 64),
        at TEXT NOT NULL, PRIMARY KEY(chain, n, hash)) STRICT, WITHOUT ROWID""",
        """CREATE TABLE heads(
        chain INTEGER NOT NULL REFERENCES chains(chain), about TEXT NOT NULL CHECK(length(about) = 64),
        n INTEGER NOT NULL, hash TEXT NOT NULL, PRIMARY KEY(chain, about)) STRICT, WITHOUT ROWID""",
        # -- derived data: claims per node and station, digests and statements, and the queue of nodes to merge again
        """CREATE TABLE event_ids(
        chain INTEGER NOT NULL, id INTEGER NOT NULL, PRIMARY KEY(chain, id)) STRICT, WITHOUT ROWID""",
        """CREATE TABLE claims(
        uuid BLOB NOT NULL CHECK(length(uuid) = 10), chain INTEGER NOT NULL REFERENCES chains(chain),
        claim TEXT NOT NULL, PRIMARY KEY(uuid, chain)) STRICT, WITHOUT ROWID""",
        "CREATE INDEX claims_of_chain ON claims(chain)",
        """CREATE TABLE digests(
        digest BLOB NOT NULL CHECK(length(digest) = 32), chain INTEGER NOT NULL REFERENCES chains(chain),
        n INTEGER NOT NULL, vouched INTEGER NOT NULL CHECK(vouched IN (0, 1)), mac BLOB CHECK(length(mac) = 16),
        PRIMARY KEY(digest, chain, vouched)) STRICT, WITHOUT ROWID""",
        """CREATE TABLE statements(
        hash TEXT NOT NULL CHECK(length(hash) = 64), chain INTEGER NOT NULL REFERENCES chains(chain),
        lifts INTEGER NOT NULL CHECK(lifts IN (0, 1)), counts INTEGER NOT NULL CHECK(counts IN (0, 1)),
        uuid BLOB CHECK(length(uuid) = 10), statement TEXT NOT NULL,
        mac BLOB CHECK(length(mac) = 16), PRIMARY KEY(hash, chain, lifts)) STRICT, WITHOUT ROWID""",
        "CREATE INDEX statements_of_node ON statements(uuid) WHERE uuid IS NOT NULL",
        """CREATE TABLE conflicts(
        uuid BLOB NOT NULL CHECK(length(uuid) = 10), conflict TEXT NOT NULL, detail TEXT NOT NULL,
        PRIMARY KEY(uuid, conflict)) STRICT, WITHOUT ROWID""",
        "CREATE TABLE to_judge(uuid BLOB PRIMARY KEY CHECK(length(uuid) = 10)) STRICT, WITHOUT ROWID",
        # -- parcels, and the receivers of copies
        """CREATE TABLE parcels(
        id TEXT NOT NULL, direction TEXT NOT NULL CHECK(direction IN ('out', 'in')),
        peer TEXT NOT NULL CHECK(length(peer) = 64), kind TEXT NOT NULL, state TEXT NOT NULL, expires TEXT NOT NULL,
        about TEXT NOT NULL, detail TEXT NOT NULL, created TEXT NOT NULL, document BLOB NOT NULL,
        PRIMARY KEY(id, direction)) STRICT""",
        """CREATE TABLE shared(
        uuid BLOB NOT NULL CHECK(length(uuid) = 10), epoch INTEGER NOT NULL, receiver TEXT NOT NULL,
        parcel TEXT NOT NULL, state TEXT NOT NULL, PRIMARY KEY(uuid, epoch, receiver)) STRICT, WITHOUT ROWID""",
        "CREATE INDEX shared_in_parcel ON shared(parcel)",
        # -- a line: jobs, their units, evidence, and requests to an office with its answers
        """CREATE TABLE jobs(
        id TEXT PRIMARY KEY, hash TEXT NOT NULL CHECK(length(hash) = 64), octets BLOB NOT NULL, state TEXT NOT NULL,
        at TEXT NOT NULL) STRICT, WITHOUT ROWID""",
        """CREATE TABLE units(
        job TEXT NOT NULL, uuid BLOB NOT NULL CHECK(length(uuid) = 10), unit INTEGER NOT NULL CHECK(unit > 0),
        at TEXT NOT NULL, attempts INTEGER NOT NULL, passed INTEGER NOT NULL, PRIMARY KEY(job, uuid),
        UNIQUE(job, unit)) STRICT, WITHOUT ROWID""",
        """CREATE TABLE evidence(
        sha256 TEXT PRIMARY KEY CHECK(length(sha256) = 64), uuid BLOB NOT NULL CHECK(length(uuid) = 10), job TEXT,
        unit INTEGER, attempt INTEGER NOT NULL, verdict TEXT NOT NULL, finished TEXT NOT NULL,
        document BLOB NOT NULL) STRICT, WITHOUT ROWID""",
        "CREATE INDEX evidence_of_node ON evidence(uuid)",
        """CREATE TABLE sign_requests(
        hash TEXT PRIMARY KEY CHECK(length(hash) = 64), direction TEXT NOT NULL CHECK(direction IN ('out', 'in')),
        job TEXT NOT NULL, uuid BLOB NOT NULL CHECK(length(uuid) = 10), peer TEXT NOT NULL, request BLOB NOT NULL,
        answer BLOB, sequence INTEGER, at TEXT NOT NULL) STRICT, WITHOUT ROWID""",
        "CREATE INDEX sign_requests_of_unit ON sign_requests(job, uuid)",
    ),
    11: (
        # The link on which a session with the node was last opened; searched first by default.
        """CREATE TABLE last_places(
        uuid BLOB PRIMARY KEY CHECK(length(uuid) = 10), place TEXT NOT NULL CHECK(place <> ''))
        STRICT, WITHOUT ROWID""",
    ),
    12: (
        # Chosen coordinate frames of channels (0: of the whole node).
        """CREATE TABLE frames(
        uuid BLOB NOT NULL CHECK(length(uuid) = 10), channel INTEGER NOT NULL CHECK(channel BETWEEN 0 AND 255),
        frame TEXT NOT NULL CHECK(frame <> ''), PRIMARY KEY(uuid, channel)) STRICT, WITHOUT ROWID""",
    ),
    # The owner of each measurement, which decides whether it lasts; earlier ones that did not last were a command's.
    13: (
        "ALTER TABLE measurements RENAME TO measurements_before",
        """CREATE TABLE measurements(
        id TEXT PRIMARY KEY CHECK(id <> ''), group_name TEXT REFERENCES groups(name) ON DELETE CASCADE,
        uuids TEXT NOT NULL, channels TEXT NOT NULL, rate REAL CHECK(rate > 0),
        kind TEXT CHECK(kind IN ('periodic', 'event', 'free')), trigger INTEGER NOT NULL CHECK(trigger IN (0, 1)),
        actuators INTEGER NOT NULL CHECK(actuators IN (0, 1)),
        dead_man INTEGER NOT NULL CHECK(dead_man BETWEEN 20 AND 10000),
        scalar_rate REAL NOT NULL CHECK(scalar_rate BETWEEN 0 AND 1000), sinks TEXT NOT NULL,
        owner TEXT NOT NULL CHECK(owner IN ('ncap', 'command', 'page') OR owner GLOB 'api:?*'),
        ends REAL, created TEXT NOT NULL,
        test_pattern INTEGER NOT NULL DEFAULT 0 CHECK(test_pattern IN (0, 1)),
        unsigned INTEGER NOT NULL DEFAULT 0 CHECK(unsigned IN (0, 1)), require TEXT NOT NULL DEFAULT '',
        match TEXT CHECK(match <> ''), frozen INTEGER NOT NULL DEFAULT 0 CHECK(frozen IN (0, 1)),
        pid INTEGER, started INTEGER,
        CHECK(owner = 'command' OR (pid IS NULL AND started IS NULL)),
        CHECK((group_name IS NOT NULL) + (uuids <> '[]') + (match IS NOT NULL) = 1)) STRICT, WITHOUT ROWID""",
        """INSERT INTO measurements SELECT id, group_name, uuids, channels, rate, kind, trigger, actuators, dead_man,
        scalar_rate, sinks, CASE lasting WHEN 1 THEN 'ncap' ELSE 'command' END, ends, created, test_pattern, unsigned,
        require, match, frozen, NULL, NULL FROM measurements_before""",
        "DROP TABLE measurements_before",
    ),
    # Groups are stored in one place: those that a bundle or `replace` wrote into a node's row are merged into the
    # measurement groups. Invalid names get a prefix, as station/groups.py `valid_name` does it. Retired nodes leave
    # their groups, as `decommission` and `replace` do today (handover/life.py).
    14: (
        "INSERT OR IGNORE INTO groups"
        f" SELECT DISTINCT {_GROUP_NAME}, strftime('%Y-%m-%dT%H:%M:%SZ', 'now') FROM {_NODES_GROUPS}",
        f"INSERT OR IGNORE INTO group_members SELECT {_GROUP_NAME}, nodes.uuid FROM {_NODES_GROUPS}",
        "DELETE FROM group_members WHERE uuid IN (SELECT uuid FROM nodes"
        " WHERE retired LIKE 'decommissioned%' OR retired LIKE 'replaced by%')",
        "ALTER TABLE nodes DROP COLUMN groups",
        "CREATE INDEX groups_of_node ON group_members(uuid)",
    ),
    # Firmware that nodes report, and the firmware under which their datasheets were signed.
    15: (
        """CREATE TABLE firmware(
        uuid BLOB PRIMARY KEY CHECK(length(uuid) = 10),
        report BLOB NOT NULL CHECK(length(report) = 0 OR length(report) BETWEEN 42 AND 90),
        in_session INTEGER NOT NULL CHECK(in_session IN (0, 1)), at TEXT NOT NULL,
        signed BLOB CHECK(length(signed) = 0 OR length(signed) BETWEEN 42 AND 90),
        mac BLOB CHECK(length(mac) = 16)) STRICT, WITHOUT ROWID""",
    ),
}


def statements(before: int, to: int = SCHEMA_VERSION) -> list[str]:
    """Return the statements that bring a store of schema ``before`` to schema ``to``.

    ``before`` is 0 for an empty file, else at least OLDEST_SCHEMA.
    """
    made = [] if before else list(_TABLES)
    return made + [statement for step in range(max(before, OLDEST_SCHEMA) + 1, to + 1) for statement in _STEPS_TO[step]]
