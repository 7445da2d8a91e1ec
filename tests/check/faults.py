"""Nodes that are each wrong in one thing, and the rule that finds each, with words of its own: one table.

A name here is that of the fault in C as well: the firmware built with ``-DFAULT_x`` is found by the same rule.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Final

from teds_provision.protocol import datasheet
from teds_provision.protocol.messages.frames import Function
from teds_provision.protocol.tim import node

from . import bends, faulty, more_bends
from .bends import Bend, agreeing_so, datasheet_signed_as, hkdf, mac, opened_by, opening_so, sealing_so, sha, signs_for
from .faulty import Fault


@dataclass(frozen=True)
class FaultyNode:
    """One faulty node: ``rule`` fails, with ``words`` in what it says, and ``slip`` where one is known.

    ``bend`` changes the reference node, ``fault`` what it answers on the link; ``link`` are fields of its link.
    ``also`` are rules that may fail beside, because they hang on the same thing; "*": any. ``over`` is where it shows.
    """

    what: str
    rule: str
    words: str
    bend: Bend | None = None
    fault: Fault | None = None
    slip: str | None = None
    also: tuple[str, ...] = ()
    over: str = "nfc"
    link: dict[str, Any] = field(default_factory=dict)


_MEASURING: Final = "measuring can"


def _slip(
    what: str, slip: str, bend: Bend, *also: str, rule: str = "agreement-tags", words: str = "", over: str = "nfc"
) -> FaultyNode:
    """Return a slip of the key agreement, of a session or of a stream."""
    return FaultyNode(what, rule, words or "A known slip fits", bend, slip=slip, also=also, over=over)


FAULTS: Final[dict[str, FaultyNode]] = {
    # -- slips of the key agreement
    "FAULT_TRANSCRIPT_LABEL_WITHOUT_00": _slip(
        "the label of T without its 00", "transcript-label-without-00",
        agreeing_so(label=b"TEDS1 transcript"), words='"TEDS1 transcript" of T lacks its 00'),
    "FAULT_TRANSCRIPT_EPOCH_LITTLE_ENDIAN": _slip(
        "a little-endian epoch in T", "transcript-epoch-little-endian",
        agreeing_so(epoch=lambda number: number.to_bytes(4, "little"))),
    "FAULT_TRANSCRIPT_EPOCH_NOT_PLUS_1": _slip(
        "the stored epoch in T", "transcript-epoch-not-plus-1",
        agreeing_so(epoch=lambda number: (number - 1).to_bytes(4, "big")), words="not the stored one + 1"),
    "FAULT_EPOCH_LITTLE_ENDIAN": _slip(
        "a little-endian epoch in the reply", "epoch-little-endian",
        agreeing_so(offered=lambda number: number.to_bytes(4, "little")), "agreement-tags",
        rule="agreement-epoch", words="little-endian"),
    "FAULT_EPOCH_STANDS_STILL": FaultyNode(
        "the stored epoch, not one more", "agreement-epoch", "not the stored one + 1",
        fault=faulty.epoch_stands_still, slip="epoch-not-plus-1", also=("agreement-tags",)),
    "FAULT_TRANSCRIPT_DIGEST_OF_DATA_BLOCK": _slip(
        "the digest in T over the data block only", "transcript-digest-of-data-block",
        agreeing_so(digest=lambda teds: sha(teds[4:-2])), words="over its data block only"),
    "FAULT_TRANSCRIPT_DIGEST_OF_NEW_EPOCH": _slip(
        "the digest in T of a TEDS with the new epoch", "transcript-digest-of-new-epoch",
        agreeing_so(digest=bends.of_new_epoch), words="has the new epoch already"),
    "FAULT_TRANSCRIPT_WITHOUT_ONE_TIME": _slip(
        "no En in T", "transcript-without-one-time", agreeing_so(with_one_time=False)),
    "FAULT_Z_HALVES_SWAPPED": _slip(
        "the halves of Z swapped", "z-halves-swapped", agreeing_so(z=lambda first, second: second + first),
        words="the halves of Z are swapped"),
    "FAULT_Z_LITTLE_ENDIAN": _slip(
        "little-endian x-coordinates", "z-little-endian",
        agreeing_so(z=lambda first, second: first[::-1] + second[::-1])),
    "FAULT_Z_ONE_TIME_ALONE": _slip(
        "Z of the one-time keys alone", "z-of-one-time-alone", agreeing_so(z=lambda first, _: first)),
    "FAULT_IDENTITY_KEY_AGREES": _slip(
        "the identity key in ECDH, as in KeyAgreement 1", "z-with-identity-key",
        agreeing_so(identity_agrees=True), words="as KeyAgreement 1 did"),
    "FAULT_SALT_AND_IKM_SWAPPED": _slip(
        "salt and ikm swapped", "salt-and-ikm-swapped",
        agreeing_so(okm=lambda z, nonce, info: hkdf(nonce, z, info, 64))),
    "FAULT_INFO_LABEL_WITHOUT_00": _slip(
        "the label of info without its 00", "info-label-without-00", agreeing_so(info=b"TEDS1 link key")),
    "FAULT_M_OF_48_OCTETS": _slip(
        "an M of 48 octets", "m-of-48-octets", agreeing_so(m=lambda okm: okm[16:64]),
        words="M has 48 octets; OKM[16:48] are 32"),
    "FAULT_M_OF_16_OCTETS": _slip(
        "an M of 16 octets", "m-of-16-octets", agreeing_so(m=lambda okm: okm[16:32])),
    "FAULT_MAC_LABEL_WITH_00": _slip(
        "a MAC label that ends in 00", "mac-label-with-00", agreeing_so(own=b"node\0", other=b"station\0"),
        words="MAC labels have none"),
    "FAULT_TAGS_SWAPPED": _slip(
        "tagN made as tagS", "mac-label-of-the-other-side", agreeing_so(own=b"station", other=b"node")),
    "FAULT_TWO_SLIPS": _slip(
        "two slips at once", "transcript-label-without-00+z-halves-swapped",
        agreeing_so(label=b"TEDS1 transcript", z=lambda first, second: second + first), words=", and the halves"),
    "FAULT_SIGN_LABEL_WITHOUT_00": _slip(
        "sigN with its label without 00", "sign-label-without-00",
        agreeing_so(sign=lambda key, _e, t, _r: key.sign(b"TEDS1 agree" + t)), words="sigN does not verify"),
    "FAULT_SIGN_WITHOUT_LABEL": _slip(
        "sigN over T alone", "sign-without-label",
        agreeing_so(sign=lambda key, _e, t, _r: key.sign(t))),
    "FAULT_SIGN_NOT_HASHED": _slip(
        "T signed as if it were the hash", "sign-not-hashed",
        agreeing_so(sign=lambda key, _e, t, _r: key.sign_digest(t)), words="as if they were the hash"),
    "FAULT_SIGN_OF_REQUEST": _slip(
        "sigN over the Request", "sign-of-request",
        agreeing_so(sign=lambda key, _e, _t, r: key.sign(b"TEDS1 agree\0" + r))),
    "FAULT_SIGN_WITH_ONE_TIME_KEY": _slip(
        "sigN by the one-time key", "sign-with-one-time-key",
        agreeing_so(sign=lambda _k, one_time, t, _r: one_time.sign(b"TEDS1 agree\0" + t))),
    "FAULT_SIGN_LITTLE_ENDIAN": _slip(
        "r and s of sigN little-endian", "signature-little-endian",
        agreeing_so(sign=lambda key, _e, t, _r: bends.reversed_halves(key.sign(b"TEDS1 agree\0" + t))),
        "agreement-low-s"),
    "FAULT_SIGN_HIGH_S": FaultyNode(
        "a high s in sigN", "agreement-low-s", "s of sigN is in the upper half",
        agreeing_so(sign=lambda key, _e, t, _r: bends.high(key.sign(b"TEDS1 agree\0" + t))),
        also=("agreement-tags",)),
    "FAULT_REPLY_WITH_TEDS": FaultyNode(
        "the Security TEDS behind the reply, as in KeyAgreement 1", "request",
        "success with 165 octets is due, success, 465 octets came",
        agreeing_so(reply=lambda octets: octets + bytes(300))),
    "FAULT_CONFIRM_LABEL_WITH_00": _slip(
        "tagS with a MAC label that ends in 00", "mac-label-with-00",
        bends.only_confirm(lambda m, t: mac(m, b"station\0" + t)[:16]), "confirm-ends-sessions", rule="agreement",
        words="Confirm (128.2), 16 octets: success is due, refusal 12 came"),
    "FAULT_STATION_LABEL_WITHOUT_00": _slip(
        "SIG104 looked for with its label without 00", "station-label-without-00",
        bends.station_signed_as(lambda point: b"TEDS1 station key" + point), rule="request"),
    "FAULT_K_ELSEWHERE": _slip(
        "K from another place of OKM", "k-elsewhere-in-okm", agreeing_so(k=lambda okm: okm[32:48]), rule="open"),
    # -- the agreement otherwise
    "FAULT_SAME_NONCE": FaultyNode(
        "the same nonce for every Request", "agreement-fresh", "the same nonceN", bends.nonce_twice),
    "FAULT_SAME_ONE_TIME_KEY": FaultyNode(
        "the same En for every Request", "agreement-fresh", "the same one-time key En", bends.same_one_time_key),
    "FAULT_STATIC_FOR_ONE_TIME": FaultyNode(
        "a station's static key taken for E and Es", "request-one-time", "E equal to P(station)",
        bends.static_keys_are_good, also=("open-point",)),
    "FAULT_SIGNATURE_BEFORE_POINTS": FaultyNode(
        "SIG104 looked at before the points", "request-checks", "refusal 15 is due, refusal 5 came",
        bends.signature_before_points, also=("request-one-time", "first-owner-wins")),
    "FAULT_REQUEST_HIGH_S": FaultyNode(
        "a high s in SIG104", "request-high-s", "SIG104 with a high s", bends.any_s_in_a_request),
    "FAULT_RESET_LEAVES_REQUEST": FaultyNode(
        "an agreement that survives a Reset", "reset-ends-request", "a Reset between Request and Confirm",
        bends.reset_leaves_the_request),
    "FAULT_CONFIRM_FROM_ANYWHERE": FaultyNode(
        "a Confirm from anywhere", "confirm-elsewhere", "plain, of a Request in a session",
        bends.confirm_from_anywhere, also=("confirm-other-session",)),
    "FAULT_CONFIRM_FROM_ANY_SESSION": FaultyNode(
        "a Confirm from another session", "confirm-other-session", "of a Request in an earlier session",
        bends.confirm_from_any_session),
    "FAULT_CONFIRM_FROM_ANY_LINK": FaultyNode(
        "a Confirm from another link", "confirm-other-link", "from another station's address",
        bends.confirm_from_any_link, over="can"),
    "FAULT_CONFIRM_BESIDE": FaultyNode(
        "a Confirm from another station's session", "confirm-beside", "of a Request in another session",
        bends.confirm_from_anywhere, also=("confirm-other-link", "confirm-other-session"), over="can"),
    "FAULT_WRONG_TAG_LEAVES_REQUEST": FaultyNode(
        "what pends survives a wrong tagS", "confirm-checks", "after a wrong tagS", fault=faulty.keeps_pending),
    "FAULT_FIRST_REQUEST_STAYS": FaultyNode(
        "an older Request that still counts", "confirm-newest", "of the Request before the last",
        bends.the_first_request_stays, also=("confirm-elsewhere", "confirm-ends-sessions")),
    "FAULT_SESSIONS_SURVIVE_CONFIRM": FaultyNode(
        "sessions that survive Confirm", "confirm-ends-sessions", "in the session of the Confirm",
        bends.sessions_survive_confirm, also=("reset-forgets",), over="can"),
    "FAULT_HALF_OPEN_SURVIVES_CONFIRM": FaultyNode(
        "a half-open Open that survives Confirm", "confirm-ends-sessions", "half-open Open after Confirm",
        bends.half_open_survives_confirm, over="can"),
    "FAULT_ANY_CA": FaultyNode(
        "the CA of another owner", "first-owner-wins", "another owner's CA", fault=faulty.any_ca),
    "FAULT_REQUEST_UNTAPPED": FaultyNode(
        "a Request without a tap", "keyed-untapped", "refusal 3 is due", over="can", link={"tapped_when_keyed": True}),
    # -- frames, Identify, Prove
    "FAULT_UNKNOWN_IS_SILENT": FaultyNode(
        "an unknown command answered by 0 octets", "unknown-command", "128.99",
        fault=faulty.unknown_is_silent, also=("max-message", "refusal-form")),
    "FAULT_LONG_REFUSAL": FaultyNode(
        "a refusal of two octets", "refusal-form", "2 octets", fault=faulty.long_refusal, also=("*",)),
    "FAULT_LENGTH_BEFORE_STATE": FaultyNode(
        "lengths before state", "state-before-length", "refusal 3 is due, refusal 4 came",
        fault=faulty.length_before_state),
    "FAULT_HEADER_LENGTH_IGNORED": FaultyNode(
        "the length in the header ignored", "frame-length", "length", fault=faulty.header_length_ignored, also=("*",)),
    "FAULT_LONGER_THAN_MAX_MESSAGE": FaultyNode(
        "less than maxMessage is taken", "max-message",
        "a frame of maxMessage octets: refusal 1 is due, refusal 10 came",
        fault=faulty.half_of_max_message, also=("write-drops",)),
    "FAULT_PROVE_HIGH_S": FaultyNode(
        "a high s in Prove", "prove-low-s", "upper half", fault=faulty.high_s),
    "FAULT_PROVE_ANY_CHALLENGE": FaultyNode(
        "a challenge of any length", "prove-length", "refusal 4 is due", fault=faulty.any_challenge),
    "FAULT_PROVE_OTHER_KEY": FaultyNode(
        "Prove under another key", "prove", "does not verify", fault=faulty.proof_of_another),
    "FAULT_PROVE_LABEL_WITHOUT_00": _slip(
        "Prove with its label without 00", "label-without-00",
        signs_for(Function.PROVE, lambda uuid, challenge, _: b"TEDS1 prove" + uuid + challenge), rule="prove"),
    "FAULT_PROVE_NOT_HASHED": _slip(
        "the challenge signed as if it were the hash", "sign-not-hashed", bends.prove_as_digest, rule="prove"),
    "FAULT_RESET_WITHOUT_EPOCH": _slip(
        "Reset signed without the epoch", "without-epoch",
        signs_for(Function.RESET, lambda uuid, challenge, _: b"TEDS1 reset\0" + uuid + challenge),
        "reset", rule="factory-reset"),
    "FAULT_RESET_HIGH_S": FaultyNode(
        "a high s in the proof of Reset", "reset-low-s", "Reset (128.9): s is in the upper half",
        fault=faulty.high_s_in_reset),
    "FAULT_NODE_KEY_WITHOUT_UUID": _slip(
        "field 102 without the UUID", "without-uuid", bends.node_key_without_uuid, "*", rule="node-key"),
    "FAULT_IDENTIFY_ANY_PAYLOAD": FaultyNode(
        "Identify with a payload", "no-payload", "one octet of payload", fault=faulty.identify_any_payload),
    # -- the firmware
    "FAULT_ABOUT_FORM": FaultyNode(
        "About of another form", "about", "form 2", fault=faulty.about_of_form_2,
        also=("about-keyed", "about-in-session", "locate", "locate-in-session"), over="can"),
    "FAULT_ABOUT_ANY_PAYLOAD": FaultyNode(
        "About with a payload", "about", "refusal 4 is due", fault=faulty.about_with_any_payload,
        also=("about-in-session",)),
    "FAULT_ABOUT_BY_RADIO": FaultyNode(
        "About by radio, with a key", "about-keyed", "refusal 3 is due", fault=faulty.about_by_radio),
    "FAULT_LOCATE_FOR_ANYONE": FaultyNode(
        "a keyed board that blinks for anyone", "locate-keyed", "refusal 3 is due", fault=faulty.locates_for_anyone),
    "FAULT_LOCATE_FOR_LONG": FaultyNode(
        "Locate for more than a minute", "locate", "payload 3d: refusal 4 is due", fault=faulty.locates_for_long,
        also=("locate-in-session",)),
    "FAULT_MANAGE_UNKNOWN": FaultyNode(
        "Manage unknown outside a session", "manage-needs-session", "refusal 3 is due",
        fault=faulty.manage_is_unknown),
    # -- TEDS
    "FAULT_LIST_TWICE": FaultyNode(
        "List does not ascend", "list-ascending", "does not ascend", fault=faulty.list_twice),
    "FAULT_LIST_LONG": FaultyNode(
        "a reply longer than maxMessage", "list-ascending", "maxMessage is 2048", fault=faulty.list_long, also=("*",)),
    "FAULT_ABSENT_AVAILABLE": FaultyNode(
        "Query of an absent TEDS without NotAvail", "query-absent", "NotAvail is due", fault=faulty.absent_is_available,
        also=("staging-ends",)),
    "FAULT_TEXT_ATTRIBUTE": FaultyNode(
        "TextTEDS where it is none", "query-present", "TextTEDS is 1", fault=faulty.all_text, also=("staging-ends",)),
    "FAULT_TEDS_CHECKSUM": FaultyNode(
        "the checksum of a TEDS", "teds-checksum", "TEDS 128 of channel 0", fault=faulty.wrong_checksum, also=("*",)),
    "FAULT_NOT_CANONICAL": FaultyNode(
        "a Security TEDS that is not canonical", "security-canonical", "Field 110", fault=faulty.not_canonical,
        also=("*",)),
    "FAULT_OTHER_SUITE": FaultyNode(
        "the suite of the draft", "security-canonical", "not those of this profile", fault=faulty.other_suite,
        also=("*",)),
    "FAULT_READ_END_REFUSED": FaultyNode(
        "Read past the end refused", "read-end", "success is due, refusal 18 came", fault=faulty.end_refused),
    "FAULT_STALE_INITIAL": FaultyNode(
        "an initial TEDS of an older epoch", "keyed-security", "Field 107", fault=faulty.stale_initial,
        also=("confirm-elsewhere", "*")),
    "FAULT_WRITE_ANYWHERE": FaultyNode(
        "Write outside a session", "write-needs-session", "refusal 3 is due", fault=faulty.write_anywhere,
        also=("state-before-length", "*")),
    # -- sessions
    "FAULT_OPEN_ANY_MAC": FaultyNode(
        "Open with a wrong mac", "open-checks", "a wrong mac", fault=faulty.any_mac, also=("open-once", "open-point")),
    "FAULT_KEY_ID_LABEL_WITHOUT_00": _slip(
        "keyId with its label without 00", "key-id-label-without-00",
        bends.keys_known_as(lambda key: sha(b"TEDS1 key id" + key)[:8]), "open-checks", rule="open"),
    "FAULT_OPEN_MAC_LABEL_WITH_00": _slip(
        "mac with a label that ends in 00", "mac-label-with-00",
        opened_by(lambda key, uuid, c, point: mac(key, b"station open\0" + uuid + c + point)[:16]), rule="open"),
    "FAULT_OPEN_MAC_COUNTER_LITTLE_ENDIAN": _slip(
        "a little-endian c in mac", "mac-counter-little-endian",
        opened_by(lambda key, uuid, c, point: mac(key, b"station open" + uuid + c[::-1] + point)[:16]), rule="open"),
    "FAULT_OPEN_INFO_LABEL_WITHOUT_00": _slip(
        "the label of the session without its 00", "info-label-without-00", opening_so(label=b"TEDS1 session"),
        rule="open"),
    "FAULT_OPEN_SALT_AND_IKM_SWAPPED": _slip(
        "salt and ikm of the session swapped", "salt-and-ikm-swapped",
        opening_so(okm=lambda z, key, info: hkdf(key, z, info, 96)), rule="open"),
    "FAULT_OPEN_KC_OF_16_OCTETS": _slip(
        "a k_c of 16 octets", "kc-of-16-octets", opening_so(kc=lambda okm: okm[32:48]), rule="open"),
    "FAULT_OPEN_TAG_LABEL_WITH_00": _slip(
        "the tag of Open with a label that ends in 00", "mac-label-with-00", opening_so(tag_label=b"node open\0"),
        rule="open"),
    "FAULT_OPEN_POINTS_SWAPPED": _slip(
        "En before Es", "info-node-first", opening_so(points=lambda station, node: node + station), rule="open"),
    "FAULT_SESSION_KEYS_SWAPPED": _slip(
        "k_sn and k_ns swapped", "session-keys-swapped", opening_so(swapped=True), rule="open"),
    "FAULT_NONCE_COUNTER_FIRST": _slip(
        "the counter first in the nonce", "nonce-counter-first",
        bends.unsealing_so(nonce=lambda counter: counter + bytes(9)), rule="open"),
    "FAULT_AAD_COUNTER": _slip(
        "the counter as AAD", "aad-counter", bends.unsealing_so(aad=True), rule="open"),
    "FAULT_REPLY_COUNTER_LITTLE_ENDIAN": _slip(
        "a little-endian counter in sealed replies", "counter-little-endian",
        sealing_so(head=lambda counter: counter.to_bytes(4, "little")), rule="open"),
    "FAULT_REPLY_NONCE_COUNTER_FIRST": _slip(
        "the counter first in the nonce of replies", "nonce-counter-first",
        sealing_so(nonce=lambda counter: counter + bytes(9)), rule="open"),
    "FAULT_PKCS7_NO_FULL_BLOCK": _slip(
        "no block of padding where the reply is a multiple of 16", "padding-no-full-block",
        sealing_so(padding=bends.no_full_block), rule="sealed-residues", words="padding of a sealed reply is wrong"),
    "FAULT_PADDING_ZEROS": _slip(
        "zeros in place of PKCS #7", "padding-zeros", sealing_so(padding=bends.zeros), rule="open",
        words="padding of a sealed reply is wrong"),
    "FAULT_PADDING_NOT_LOOKED_AT": FaultyNode(
        "padding that is wrong", "sealed-padding", "padding", bends.any_padding),
    "FAULT_OPEN_SAME_ONE_TIME_KEY": FaultyNode(
        "a one-time key for every Open", "open-one-time", "the same one-time key En", bends.one_time_key_twice),
    "FAULT_OPEN_ENDS_SESSION": FaultyNode(
        "an Open that ends the session", "open-beside", "beside a half-open Open", bends.open_ends_the_session),
    "FAULT_FIRST_OPEN_STAYS": FaultyNode(
        "an older Open that still counts", "open-replaced", "under an Open that was replaced",
        bends.the_first_open_stays, also=("*",)),
    "FAULT_C_GROWS_BY_2": FaultyNode(
        "c grows by 2", "open-once", "+ 1 is due", bends.c_grows_by_two),
    "FAULT_C_LITTLE_ENDIAN": _slip(
        "c counted little-endian", "counter-little-endian", bends.c_little_endian, rule="open-once"),
    "FAULT_BAD_POINT_COSTS_NO_C": FaultyNode(
        "a good mac over a bad point that can be used again", "open-point", "c did not grow",
        bends.a_bad_point_costs_no_c),
    "FAULT_ANY_COUNTER": FaultyNode(
        "a second sealed reply for a counter", "sealed-counter", "a second time", fault=faulty.any_counter,
        also=("sealed-last-counter",)),
    "FAULT_LOWER_COUNTER": FaultyNode(
        "a counter below the last one", "sealed-counter", "counter 8: refusal 13 is due", fault=faulty.lower_counters),
    "FAULT_FIRST_COUNTER_0": FaultyNode(
        "a session that begins with counter 0", "sealed-counter", "counter 0 as the first",
        fault=faulty.first_counter_0),
    "FAULT_LAST_COUNTER": FaultyNode(
        "a session beyond the last counter", "sealed-last-counter", "refusal 2 is due",
        lambda patch: patch.setattr(node, "LAST_COUNTER", -1)),
    "FAULT_CLOSE_IGNORED": FaultyNode(
        "Close ends nothing", "close", "after Close", fault=faulty.close_is_ignored, also=("*",)),
    "FAULT_ONE_SESSION": FaultyNode(
        "room for one session", "two-sessions", "a sealed reply is due, refusal 2 came", bends.room_for_one,
        also=("stranger-ends-nothing", "session-bound", "repetition-two", "confirm-beside", "staging-shared",
              "confirm-ends-sessions",
              "address-moves", "reset"),
        over="can"),
    "FAULT_STRANGER_ENDS_SESSION": FaultyNode(
        "a third station's Identify that ends a session", "stranger-ends-nothing", "from a third station",
        bends.a_third_link_takes_the_place_of_a_session, also=("confirm-ends-sessions",), over="can"),
    "FAULT_RUNS_AGAIN": FaultyNode(
        "a repetition that is run again", "repetition", "the stored reply is due",
        link={"runs_again": lambda frame: frame[3] == Function.SEALED}),
    "FAULT_EVERYONE_DROPS_REPLY": FaultyNode(
        "a functional Identify drops the stored reply", "repetition-everyone", "after a functional Identify",
        over="can", link={"everyone_counts": True}),
    "FAULT_BUSY_SILENT": FaultyNode(
        "a second station's first frame that is not answered", "can-busy", "nothing came", over="can",
        link={"one_buffer": b""}),
    # -- writing
    "FAULT_WRITE_KEEPS_REST": FaultyNode(
        "Write keeps what lay behind", "write-drops", "its end was dropped", bends.write_keeps_the_rest,
        also=("write-keeps", "commit-digests")),
    "FAULT_ANY_SIZE": FaultyNode("more than MaxTEDSSize", "write-drops", "refusal 10 is due", bends.any_size),
    "FAULT_REFUSED_WRITE_DROPS": FaultyNode(
        "a refused Write drops what is staged", "write-keeps", "after a refused Write", bends.a_refused_write_drops),
    "FAULT_EMPTY_WRITE": FaultyNode(
        "an empty Write stages nothing", "write-keeps", "an empty image is staged",
        bends.an_empty_write_stages_nothing),
    "FAULT_STAGING_FOR_EVER": FaultyNode(
        "staged TEDS live on", "staging-ends", "earlier session", bends.staging_for_ever, also=("*",)),
    "FAULT_STAGING_PER_SESSION": FaultyNode(
        "a staging area for each session", "staging-shared", "refusal 17 is due, success", bends.staging_per_session,
        over="can"),
    "FAULT_DIGEST_NOT_LOOKED_AT": FaultyNode(
        "a digest that is not looked at", "commit-digest", "another digest", bends.listed_is_enough),
    "FAULT_DIGEST_OF_DATA_BLOCKS": _slip(
        "digests of 108 over data blocks only", "digest-of-data-block", bends.digest_of_data_blocks,
        "commit-uuid", "commit-sequence", "commit-epoch", "commit-extra", rule="commit"),
    "FAULT_DATASHEET_LABEL_WITHOUT_00": _slip(
        "TBS with its label without 00", "datasheet-label-without-00",
        datasheet_signed_as(lambda uuid, block: b"TEDS1 datasheet" + uuid + block),
        "commit-digests", "commit-digest", "commit-uuid", "commit-sequence", "commit-epoch", "commit-extra",
        rule="commit"),
    "FAULT_OWN_CHECK": FaultyNode(
        "a staged TEDS with a wrong checksum", "commit-own-check", "checksum of a staged TEDS",
        lambda patch: patch.setattr(datasheet, "passes_own_check", lambda *_: True)),
    "FAULT_ANY_VALUES": FaultyNode(
        "fields of another profile", "commit-values", "with 9",
        lambda patch: patch.setattr(datasheet, "own_values", lambda _: True)),
    "FAULT_META_OF_ANOTHER": FaultyNode(
        "the Meta-TEDS of another node", "commit-uuid", "another UUID",
        lambda patch: patch.setattr(datasheet, "meta_names", lambda *_: True)),
    "FAULT_REFUSED_COMMIT_COUNTS": FaultyNode(
        "a refused commit uses a sequence up", "commit-signatures", "changed the node",
        bends.a_refused_commit_counts, also=("*",)),
    "FAULT_OLD_SEQUENCE": FaultyNode(
        "a commit that takes an old sequence", "commit-sequence", "the stored sequence", bends.takes_an_old_sequence),
    "FAULT_DATASHEET_HIGH_S": FaultyNode(
        "a high s in a datasheet", "commit-high-s", "100 with a high s", bends.any_s_in_a_datasheet),
    "FAULT_UTF8_NOT_CHECKED": FaultyNode(
        "UTF-8 not checked", "commit-utf8", "field 5", bends.any_text),
    "FAULT_BASE64_NOT_STRICT": FaultyNode(
        "base64 not strict", "commit-base64", "spare bits not zero", bends.any_base64),
    "FAULT_REFUSES_111": FaultyNode(
        "fields 111 to 255 refused", "commit-extra", "field 200", bends.refuses_111),
    "FAULT_111_NOT_COVERED": FaultyNode(
        "fields 111 to 255 not covered", "commit-extra", "changed after signing", bends.signs_without_111),
    # -- address, lease, reset
    "FAULT_ADDRESS_240": FaultyNode(
        "CAN address 240", "address-checks", "refusal 4 is due", bends.any_address),
    "FAULT_ADDRESS_TOO_SOON": FaultyNode(
        "the new address before the reply has left", "address-moves", "its reply never came from",
        over="can", link={"moves_too_soon": True}, slip="address-before-reply", also=("address-back",)),
    "FAULT_ADDRESS_STAYS": FaultyNode(
        "an answer at the old address too", "address-moves", "still answers at", over="can",
        link={"stays_at_the_old": True}),
    "FAULT_ADDRESS_AGAIN": FaultyNode(
        "two addresses within 10 s", "address-moves", "a second write within 10 s", bends.no_seconds_between_addresses),
    "FAULT_LEASE_0": FaultyNode(
        "a lease of 0", "operate-lease", "lease 0", bends.any_lease, over="measuring"),
    "FAULT_LEASE_255": FaultyNode(
        "a lease of 255", "operate-lease", "lease 255", more_bends.lease_of_255, over="measuring"),
    "FAULT_RESET_FORGETS_EPOCH": FaultyNode(
        "an epoch that goes back with Reset", "reset", "epoch", fault=faulty.reset_forgets_epoch),
    "FAULT_RESET_TAKES_TEDS": FaultyNode(
        "Reset takes the other TEDS", "reset", "other TEDS",
        bends.reset_to(lambda _, reset: replace(reset, blocks={}))),
    "FAULT_RESET_KEEPS_CA": FaultyNode(
        "Reset keeps the CA", "reset-forgets", "success is due",
        bends.reset_to(lambda old, reset: replace(reset, ca=old.ca))),
    "FAULT_RESET_ANY_CHALLENGE": FaultyNode(
        "Prove and Reset with any challenge", "prove-length", "refusal 4 is due", bends.any_challenge_of_reset,
        also=("reset",)),
    # -- what a station sees of comparisons, repetition and the commit
    "FAULT_OPEN_MAC_OF_8_OCTETS": FaultyNode(
        "mac of Open compared over 8 octets", "open-checks", "a mac whose octet 8 alone is wrong",
        more_bends.open_mac_of_8_octets),
    "FAULT_KEY_ID_OF_4_OCTETS": FaultyNode(
        "keyId compared over 4 octets", "open-checks", "a keyId of which 4 octets are right",
        more_bends.key_id_of_4_octets),
    "FAULT_STATION_TAG_OF_8_OCTETS": FaultyNode(
        "tagS compared over 8 octets", "confirm-whole-tag", "octet 15 of tagS alone wrong",
        more_bends.station_tag_of_8_octets, over="can", also=("agreement", "confirm-newest")),
    "FAULT_REQUEST_RUNS_AGAIN": FaultyNode(
        "a repeated Request that is run again", "repetition-request", "It was run again",
        link={"runs_again": lambda frame: frame[3] == Function.REQUEST}),
    "FAULT_OPEN_RUNS_AGAIN": FaultyNode(
        "a repeated Open that is run again", "repetition-open", "refusal 12 came",
        link={"runs_again": lambda frame: frame[3] == Function.OPEN}),
    "FAULT_SESSION_OF_ANY_ADDRESS": FaultyNode(
        "a session that belongs to no address", "session-bound", "from another station's address",
        more_bends.session_of_any_address, over="can", also=("*",)),
    "FAULT_OLDER_EPOCH": FaultyNode(
        "a commit of an older epoch", "commit-epoch", "an epoch behind", more_bends.takes_an_older_epoch),
    "FAULT_CALIBRATION_CHECKSUM": FaultyNode(
        "the checksum of a Calibration TEDS ignored", "update-codes", "access code 5, checksum wrong",
        more_bends.calibration_unchecked),
    "FAULT_NEVER_PROVISIONED": FaultyNode(
        "a node that never says provisioned", "commit", "Identify says keyed; provisioned is due",
        more_bends.never_provisioned),
    "FAULT_STAGING_SURVIVES_COMMIT": FaultyNode(
        "staged TEDS that survive the commit", "commit", "success is due, refusal 6 came",
        more_bends.staging_survives_the_commit),
    "FAULT_ROTATION_UNPROVISIONS": FaultyNode(
        "a rotation that takes the datasheet away", "rotation-keeps", "provisioned became keyed",
        more_bends.rotation_unprovisions),
    "FAULT_READ_STAGED": FaultyNode(
        "Read gives what is staged", "staged-unseen", "staged, not committed", more_bends.read_gives_what_is_staged),
    "FAULT_UPDATE_STORES": FaultyNode(
        "Update of one TEDS stores it", "staged-unseen", "alone", more_bends.update_stores_at_once, also=("*",)),
    "FAULT_WRITE_READ_ONLY": FaultyNode(
        "a read-only TEDS that is written", "write-read-only", "is read-only", more_bends.writes_read_only,
        over="nfc read-only"),
    # -- frames of CAN
    "FAULT_ANY_TARGET": FaultyNode(
        "frames for other addresses answered", "can-other-address", "the node at", more_bends.answers_for_any_address,
        over="can"),
    "FAULT_ANYTHING_FUNCTIONAL": FaultyNode(
        "any command answered that everyone is asked", "can-functional", "only Identify is answered",
        more_bends.runs_what_everyone_is_asked, over="can"),
    "FAULT_ANY_SEQUENCE_NUMBER": FaultyNode(
        "sequence numbers of ISO-TP ignored", "can-sequence", "a reply came", more_bends.any_sequence_number,
        over="can"),
    "FAULT_BLOCK_SIZE_IGNORED": FaultyNode(
        "block size ignored", "can-flow-obeyed", "more frames came without a flow control",
        more_bends.block_size_ignored, over="can"),
    "FAULT_STMIN_IGNORED": FaultyNode(
        "STmin ignored", "can-flow-obeyed", "STmin 50 ms was asked for", more_bends.stmin_ignored, over="can"),
    "FAULT_WAIT_IGNORED": FaultyNode(
        "a flow control that says wait taken for go on", "can-flow-obeyed", "with Wait", more_bends.wait_is_go_on,
        over="can"),
    "FAULT_SHORT_FIRST_FRAME": FaultyNode(
        "a first frame of 7 octets", "can-lengths", "a first frame of 7 octets", more_bends.short_first_frame,
        over="can"),
    "FAULT_ESCAPED_CLASSIC_FRAME": FaultyNode(
        "the length of CAN FD in a classic single frame", "can-lengths", "a classic single frame",
        more_bends.escape_in_a_classic_frame, over="can"),
    "FAULT_ANNOUNCE_CRC": FaultyNode(
        "a wrong CRC in Announce", "can-announce", "is due", more_bends.announces_another_crc, over="can"),
    "FAULT_CLAIM_REVERSED": FaultyNode(
        "the greater CRC keeps the address", "can-announce", "the node moved to",
        more_bends.claim_the_wrong_way_round, over="can", also=("*",)),
    "FAULT_PRESSED_CLAIMS": FaultyNode(
        "a pressed button taken for a claim", "can-pressed", "takes it for a claim",
        more_bends.a_pressed_button_claims, over="can"),
    # -- measurement
    "FAULT_OPERATE_ANY_DIGEST": FaultyNode(
        "Operate with any digest", "operate-digest", "octet 0 of the digest changed", more_bends.any_digest,
        over="measuring"),
    "FAULT_WRITE_UNDER_CLAIM": FaultyNode(
        "Write under a claim", "operate-configuration", "refusal 2 is due", more_bends.writes_under_a_claim,
        over="measuring"),
    "FAULT_VALUES_UNCLAIMED": FaultyNode(
        "values of a channel that is not claimed", "operate-values", "not claimed", more_bends.values_unclaimed,
        over="measuring"),
    "FAULT_LEASE_FOR_EVER": FaultyNode(
        "a lease that never ends", "operate-expires", "is still claimed", more_bends.lease_for_ever, over="measuring"),
    "FAULT_STREAM_NONCE": _slip(
        "the counter first in the nonce of data messages", "nonce-counter-first",
        more_bends.stream_nonce_counter_first, rule="stream-messages", words="Data message 1 of run 1",
        over=_MEASURING),
    "FAULT_STREAM_NONCE_STANDS_STILL": _slip(
        "one nonce for every data message", "nonce-of-zeros", more_bends.stream_nonce_stands_still,
        rule="stream-messages", words="one key and nonce for many messages", over=_MEASURING),
    "FAULT_RUN_STANDS_STILL": FaultyNode(
        "every stream is run 1", "stream-messages", "run 1; 2 is due", more_bends.run_stands_still, over=_MEASURING),
    "FAULT_DRIVE_REPLAY": FaultyNode(
        "a Drive message of an older counter", "drive-replay", "a message with counter 4 was taken after counter 7",
        more_bends.drive_replayed, over=_MEASURING),
    "FAULT_DRIVE_TWICE": FaultyNode(
        "a Drive message taken twice", "drive-replay", "started it again", more_bends.drive_twice, over=_MEASURING),
    "FAULT_ANY_TOKEN": FaultyNode(
        "a trigger with any T", "trigger-token", "with another T", more_bends.any_token, over=_MEASURING),
}  # fmt: skip
