/* The life of a node's link key: agreement, rotation, commit, handover by copy and move, receipt, undo, restore, reset.
 *
 * One node, three stations that one CA certified. Every option of a process is one durable step (one transaction of the
 * store, or of the node's flash) or one message; between any two of them anything else may happen, and a station or the
 * node may be cut. Messages are lost (the step behind them does not happen), delayed (a Confirm, a bundle or a receipt
 * arrives at any later time) and doubled (it may arrive again). model/README.md maps each step to the code and says what
 * is left out.
 *
 * Rules that can be broken to see that the model notices (spin -DBREAK_LIFTED ...); model/README.md explains the harmless ones:
 *   BREAK_M1      the sequence of a bundle is taken for true
 *   BREAK_LIFTED         any trusted station lifts a tombstone
 *   BREAK_BACK_NO_ROTATION  a node that is handed back is used without a rotation
 *   BREAK_UNSETTLED      a move exports the active key while an agreement is unsettled
 *   BREAK_RECEIPT_ALL    a receipt deletes every key, not only the one that was in the bundle: harmless
 *   BREAK_M6      a store brought back from a backup is used as if nothing had happened since
 *   BREAK_PENDING the new key is stored after Confirm left, not before
 *   BREAK_HELD_BACK  an Open under the old key deletes the new one, whose Confirm was held back on the way
 *   BREAK_OLD_PENDING  any pending key that opens ends a due rotation, also one made before the rotation was due
 *   BREAK_REFUSAL a refused Open deletes the key that was tried
 *   BREAK_LATE    (with MOVE_DUE) a late receipt deletes the key though the node has come back since
 *   BREAK_EPOCH_BACK     a reset puts the node's epoch back
 *   BREAK_SEQUENCE_BACK  a reset puts the node's sequence back
 *   BREAK_SIGNER         the signer does not look at the node's sequence
 *   BREAK_STALE_EPOCH    the node takes a datasheet that was signed for an earlier epoch
 *   BREAK_MOVE_ORDER     the file of a move is written before its tombstone
 *   BREAK_COPY_ORDER     the file of a copy is written before the receiver is noted as a holder
 *   BREAK_MOVE_NO_ROTATION  the receiver of a move does not rotate
 *   BREAK_UNDO           a move that is taken back demands no rotation
 *   BREAK_EARLY_DELETE   the old key is deleted when the new one is stored, before an Open has proven it
 *   BREAK_DROP_PENDING   a new agreement drops the pending key of the one before it
 *   BREAK_ROTATED_EARLY  a due rotation counts as done when the new key is stored
 *   BREAK_NEVER_FORGETS  a Request is good for longer than the station waits for it
 *   BREAK_ANY_CONFIRM    a Confirm is good for another agreement than its own
 *   BREAK_BEFORE_OPEN    an Open is not needed: Confirm alone makes the new key the only one
 *   BREAK_RECEIPT_FIRST  the receipt leaves before what it tells of is durable
 *   BREAK_RECEIPT_OTHER  a receipt closes whatever move stands, not the one that it names
 *   BREAK_IMPORT_OLDER   a bundle with an older key is taken in, in the place of the key that is held
 *   BREAK_IMPORT_REPLACES  a bundle's key takes the place of the held one before an Open has proven it: harmless
 *   BREAK_RESET_REPLAY   an old proof of a reset counts (no fresh challenge)
 *   BREAK_RESET_UNPROVEN a station believes that a node was reset because it says so
 *   BREAK_RESET_RAM      a reset leaves the agreement under way
 *   BREAK_RESET_FACTORY  a Reset in factory state leaves it
 *   BREAK_KEEPS_OLD      the node opens sessions under the key before the present one too
 *   BREAK_SESSION        a session outlives the Confirm that replaces its key
 *   BREAK_SESSION_RESET  a session outlives a reset
 *   BREAK_RESET_KEEPS    a reset leaves the node's key in flash
 *   BREAK_MEASURED_ON    a session goes on although the station has given the node away
 *   BREAK_ERASE          a node that was cut in Confirm does not erase the old key when it starts
 *   BREAK_GIVEN_REQUEST  a station agrees on a key although it gave the node away
 *   BREAK_GIVEN_OPEN     a station opens sessions although it gave the node away
 *   BREAK_GIVEN_COMMIT   a station commits although it gave the node away
 *   BREAK_COPY_DUE       a key is copied although a rotation is due
 *   BREAK_MOVE_DUE       a key is moved although a rotation is due: harmless
 *   BREAK_BACKUP_TOMBSTONE  a backup leaves out that a node was given away
 *   BREAK_CONTINUED      an interrupted move is carried on to another receiver
 *   BREAK_UNDO_CLOSED    a move is taken back although its receipt came
 *   BREAK_COPY_UNAWARE   the receiver of a copy does not note that the sender has the key
 *   BREAK_RECEIPT_COPY   the receipt of a copy deletes the key
 *   BREAK_COPY_CLOSED    the receipt of a copy ends the note that its receiver has the key
 *   BREAK_ANY_OPEN       an Open under any key ends a due rotation
 *   BREAK_CONFIRM_TWICE  a Confirm does not use the agreement up
 *   BREAK_COMMIT_UNKEYED a node takes a datasheet outside a session
 *   BREAK_IMPORT_TWICE   a bundle that was taken in is taken in again: harmless
 *   BREAK_EPOCH_UNCHECKED  a station takes an offered epoch that is not newer than its own: harmless
 */

#ifndef AGREEMENTS
#define AGREEMENTS 3
#endif
#ifndef BUNDLES
#define BUNDLES 2
#endif
#ifndef COMMITS
#define COMMITS 1
#endif
#ifndef RESTORES
#define RESTORES 1
#endif
#ifndef RESETS
#define RESETS 1
#endif

#define STATIONS 3
#define KEYS (AGREEMENTS + 1)	/* key 0 is "none" */
#define NOBODY 7
#define BIT(k) (1 << (k))
#define STEP 4			/* stands for the 65,536 that a node lets a sequence grow at once */
#define LIE 9			/* what a lying bundle says of the sequence */

/* ---- traces: with -DTRACED every step is printed with the state that it leaves (model/replay.py) -------------------- */
#ifdef TRACED
c_decl {
	unsigned char path[64], aims[64];
	/* A part of the step that SCRIPT ("step.station.aim step.station.aim ...") names for a turn, -1 behind its end. */
	static int script_of(int turn, int part)
	{
		const char *at = getenv("SCRIPT");
		for (; at != NULL && turn > 0; turn--) {
			at = strchr(at, ' ');
			at = at != NULL ? at + 1 : NULL;
		}
		for (; at != NULL && part > 0; part--) {
			at = strchr(at, '.') + 1;
		}
		return at != NULL && *at != 0 ? atoi(at) : -1;
	}
	static int scripted(int turn) { return script_of(turn, 0) >= 0; }
	/* Whether this step may come now: the script's own, and any behind its end up to DEPTH. */
	static int wanted(int turn, int step, int station)
	{
		return scripted(turn) ? script_of(turn, 0) == step && script_of(turn, 1) == station : turn < atoi(getenv("DEPTH"));
	}
	static int aimed(int turn, int aim) { return !scripted(turn) || script_of(turn, 2) == aim; }
}
c_track "path" "64" "UnMatched";
c_track "aims" "64" "UnMatched";
byte turn, printed, last, aim;
bool refused;
short able;			/* bits 3 n + s: station s may take bundle n in; bits 9 + s: its Open would succeed */
/* The brackets around a function keep SPIN from taking its call for a side effect. */
#define MAY(step) (printed == turn && c_expr { (wanted)(now.turn, step, Pstation->s) })
#define MAY_NODE(step) (printed == turn && c_expr { (wanted)(now.turn, step, 0) })
#define DID(step, s) last = 4 * step + s; aim = 0; turn++; c_code { if (readtrail) printf("DID %d.%d\n", now.last / 4, now.last % 4); }
#define AIM(n) aim = n; c_code { if (readtrail) printf("AIM %d\n", now.aim); }
#define TO(n) c_expr { (aimed)(now.turn - 1, n) }	/* in the step itself; TO_NEXT: in the guard before it */
#define TO_NEXT(n) c_expr { (aimed)(now.turn, n) }
#else
#define MAY(step) true
#define MAY_NODE(step) true
#define DID(step, s) skip
#define AIM(n) skip
#define TO(n) true
#define TO_NEXT(n) true
#endif
/* Steps, as a trace numbers them. */
#define CUT 0
#define REQUEST 1
#define STORE 2
#define SEND_CONFIRM 3
#define END_CONFIRM 4
#define OPEN 5
#define FORGET 6
#define MOVE 7
#define FILE 8
#define FILE_AGAIN 9
#define UNDO 10
#define COPY 11
#define IMPORT 12
#define RECEIPT 13
#define BACKUP 14
#define RESTORE 15
#define RESET 16
#define PROOF 17
#define CONFIRM 18
#define LOST_RAM 19
#define SESSION 20
#define END_SESSION 21
#define SIGN 22
#define COMMIT 23

/* ---- the node ------------------------------------------------------------------------------------------------- */
byte node_key, node_epoch, node_sequence;
byte ram;			/* the key that a good Request left in RAM */
byte top_epoch, top_sequence;	/* for the properties alone: the highest that the node ever had */
byte overtaken;			/* likewise: the key of an agreement that a reset came into */
#ifdef BREAK_KEEPS_OLD
byte node_before;
#endif
#ifdef BREAK_ERASE
#define SLOTS
#endif
#ifdef SLOTS
bool booting, residue;		/* a cut in Confirm; an old key still lies in flash */
#define UP !booting
#else
#define UP true
#endif

/* ---- keys ------------------------------------------------------------------------------------------------------ */
byte keys = 1;			/* the next key to be made */
byte epoch_of[KEYS];
byte maker[KEYS];
bool confirm_sent[KEYS];	/* its Confirm is on the way; it may arrive late, never, or twice */

/* ---- stations: what is durable ---------------------------------------------------------------------------------- */
typedef Station {
	byte present_key;
	byte held;		/* bits: every key held, pending ones and the active one */
	byte sequence;
	byte tombstone;		/* the bundle by which the node was given away, NOBODY for none */
	bool due;		/* a rotation is due */
	byte due_since;		/* only a key made from then on ends it */
	bool shared;		/* others are known to hold this key too */
	byte imported;		/* bits: bundles taken in */
	byte closed;		/* bits: bundles of its own whose receipt came */
	byte undone		/* bits: moves of its own that were taken back */
}
Station st[STATIONS];
Station snapshot;		/* the backup of one station */
byte backed_up = NOBODY;

/* ---- stations: what a cut takes -------------------------------------------------------------------------------- */
mtype = { idle, replied, stored, confirming, signed_, given };
mtype at[STATIONS];
#if defined(BREAK_SESSION) || defined(BREAK_SESSION_RESET) || defined(BREAK_MEASURED_ON) || defined(BREAK_GIVEN_OPEN)
#ifndef SESSIONS_TOO
#define SESSIONS_TOO
#endif
#endif
#ifdef SESSIONS_TOO
byte session[STATIONS];		/* the key under which it is open, 0 for none */
#define END_SESSIONS session[0] = 0; session[1] = 0; session[2] = 0
#else
#define END_SESSIONS skip
#endif
byte fresh[STATIONS];		/* the key of the agreement under way */
byte number[STATIONS];		/* the sequence being written, or the bundle being made */

/* ---- bundles ---------------------------------------------------------------------------------------------------- */
typedef Bundle {
	byte sender; byte receiver; byte key; bool move; bool made; bool receipt;
	bool due		/* for the properties: its sender was to rotate the key that left */
}
Bundle bundle[BUNDLES];
byte bundles;

/* ---- for the properties alone ----------------------------------------------------------------------------------- */
byte given_to[STATIONS];	/* to whom it gave the node, until it is handed back, undone or rotated away */
byte given_in_backup = NOBODY;	/* the same, as the backup knows it */
bool restored;			/* a store was lost and came back older: keys may be gone (docs/profile.md, "What a cut leaves behind") */
byte commits, restores, resets;
byte wiped;			/* the key that the last reset took from the node */

#define HOLDS(s, k) ((k) != 0 && (st[s].held & BIT(k)))
#ifdef BREAK_KEEPS_OLD
#define KNOWN(s) (HOLDS(s, node_key) || HOLDS(s, node_before))
#else
#define KNOWN(s) HOLDS(s, node_key)
#endif
#define USABLE(s) (UP && st[s].tombstone == NOBODY && KNOWN(s))
#define FREE(s) (USABLE(s) && !st[s].due)
#define OWNS(s) (given_to[s] == NOBODY)	/* it did not give the node away, or has it back */
#ifdef BREAK_GIVEN_OPEN
#define OPENS(s) (UP && KNOWN(s))
#else
#define OPENS(s) USABLE(s)
#endif
#ifdef BREAK_GIVEN_REQUEST
#define AGREES(s) true
#else
#define AGREES(s) (st[s].tombstone == NOBODY)
#endif
#ifdef BREAK_GIVEN_COMMIT
#define COMMITS_AS(s) (UP && KNOWN(s) && !st[s].due)
#else
#define COMMITS_AS(s) FREE(s)
#endif
#ifdef BREAK_EPOCH_UNCHECKED
#define NEWER(s, k) true
#else
#define NEWER(s, k) (epoch_of[k] > epoch_of[st[s].present_key])
#endif

#ifdef SESSIONS_TOO
inline cut(s) { at[s] = idle; fresh[s] = 0; number[s] = 0; session[s] = 0 }
#else
inline cut(s) { at[s] = idle; fresh[s] = 0; number[s] = 0 }
#endif
inline done(s) { at[s] = idle; fresh[s] = 0; number[s] = 0 }

inline demand_rotation(s) { st[s].due = true; st[s].due_since = keys }

#ifdef BREAK_UNSETTLED
#define SETTLED(s) true
#else
#define SETTLED(s) (st[s].held == BIT(st[s].present_key))
#endif
#ifdef BREAK_MOVE_DUE
#define MOVES(s) true
#else
#define MOVES(s) !st[s].due
#endif
#ifdef BREAK_COPY_DUE
#define COPIES(s) true
#else
#define COPIES(s) !st[s].due
#endif

inline select_receiver(s) {
	if
	:: s != 0 && TO(0) -> b = 0
	:: s != 1 && TO(1) -> b = 1
	:: s != 2 && TO(2) -> b = 2
	fi;
	AIM(b)
}

/* No epoch goes back, nor behind that of a key that is still pending here; and after a move only the station that the node went to may hand it back. */
#ifdef BREAK_IMPORT_OLDER
#define NOT_OLDER(s, n) true
#else
#define NOT_BEFORE(s, n, k) (k >= KEYS || !HOLDS(s, k) || epoch_of[bundle[n].key] >= epoch_of[(k < KEYS -> k : 0)])
#define NOT_OLDER(s, n) (NOT_BEFORE(s, n, 1) && NOT_BEFORE(s, n, 2) && NOT_BEFORE(s, n, 3) && NOT_BEFORE(s, n, 4))
#endif
#define HANDED_BACK(s, n) (bundle[n].move && bundle[n].sender == bundle[st[s].tombstone].receiver)
#ifdef BREAK_LIFTED
#define MAY_COME(s, n) true
#else
#define MAY_COME(s, n) (st[s].tombstone == NOBODY || HANDED_BACK(s, n))
#endif
#ifdef BREAK_IMPORT_TWICE
#define NEW_HERE(s, n) true
#else
#define NEW_HERE(s, n) !(st[s].imported & BIT(n))
#endif
#define IMPORTABLE(s, n) (at[s] == idle && n < bundles && bundle[n].made && bundle[n].receiver == s && \
	NEW_HERE(s, n) && NOT_OLDER(s, n) && MAY_COME(s, n))

inline take_in(s, n) {
	if
	:: st[s].tombstone != NOBODY ->
		if
		:: HANDED_BACK(s, n) -> given_to[s] = NOBODY
		:: else
		fi;
		st[s].tombstone = NOBODY;
#ifdef BREAK_BACK_NO_ROTATION
		back = true
#endif
	:: else
	fi;
	if
#ifdef BREAK_MOVE_NO_ROTATION
	:: bundle[n].move
#elif defined(BREAK_BACK_NO_ROTATION)
	:: bundle[n].move ->
		if
		:: !back -> demand_rotation(s)
		:: else
		fi;
		back = false
#else
	:: bundle[n].move -> demand_rotation(s)		/* also where it is handed back */
#endif
#ifdef BREAK_COPY_UNAWARE
	:: else
#else
	:: else -> st[s].shared = true
#endif
	fi;
#ifdef BREAK_M1
	st[s].sequence = LIE;
#endif
#if defined(BREAK_IMPORT_OLDER) || defined(BREAK_IMPORT_REPLACES)
	st[s].held = BIT(bundle[n].key); st[s].present_key = bundle[n].key;
#else
	st[s].held = st[s].held | BIT(bundle[n].key);
#endif
	st[s].imported = st[s].imported | BIT(n);
	bundle[n].receipt = true; bundle[n].due = bundle[n].due && !bundle[n].move	/* who takes a move in rotates it */
}

#ifdef BREAK_RECEIPT_FIRST
#define RECEIPT_LEFT(n) (bundle[n].receipt || bundle[n].made)
#else
#define RECEIPT_LEFT(n) bundle[n].receipt
#endif
#define RECEIVABLE(s, n) (at[s] == idle && n < bundles && bundle[n].sender == s && RECEIPT_LEFT(n) && \
	!(st[s].closed & BIT(n)))

inline close_handover(s, n) {
	st[s].closed = st[s].closed | BIT(n);
	if
#ifdef BREAK_COPY_CLOSED
	:: !bundle[n].move -> st[s].shared = false
#endif
#ifdef BREAK_LATE
	:: bundle[n].move && !(st[s].undone & BIT(n)) ->
#elif defined(BREAK_RECEIPT_OTHER)
	:: st[s].tombstone != NOBODY ->		/* whichever stands */
		st[s].closed = st[s].closed | BIT(st[s].tombstone);
		st[s].held = st[s].held & ~BIT(bundle[st[s].tombstone].key);
#elif defined(BREAK_RECEIPT_COPY)
	:: !bundle[n].move || st[s].tombstone == n ->
#else
	:: bundle[n].move && st[s].tombstone == n ->	/* only while this very move stands */
#endif
#ifdef BREAK_RECEIPT_ALL
		st[s].held = 0; st[s].present_key = 0
#else
		st[s].held = st[s].held & ~BIT(bundle[n].key);	/* the key that was in the bundle, no other */
		if
		:: st[s].present_key == bundle[n].key -> st[s].present_key = 0
		:: else
		fi
#endif
	:: else
	fi
}

#ifdef BREAK_BACKUP_TOMBSTONE
#define COPY_TOMBSTONE(to, from) to.tombstone = NOBODY
#else
#define COPY_TOMBSTONE(to, from) to.tombstone = from.tombstone
#endif

inline copy(to, from) {
	to.present_key = from.present_key; to.held = from.held; to.sequence = from.sequence; COPY_TOMBSTONE(to, from);
	to.due = from.due; to.due_since = from.due_since; to.shared = from.shared; to.imported = from.imported;
	to.closed = from.closed; to.undone = from.undone
}

/* An Open under the node's key deletes the others, but not a newer one: its Confirm may have been held back. */
#ifdef BREAK_HELD_BACK
#define OLDER_HELD(s) (st[s].held != BIT(node_key))
#define STAYS(k) false
#else
#define OLDER_HELD(s) (OLDER(s, 1) || OLDER(s, 2) || OLDER(s, 3) || OLDER(s, 4))
#define OLDER(s, k) (k < KEYS && k != node_key && HOLDS(s, k) && epoch_of[(k < KEYS -> k : 0)] <= epoch_of[node_key])
#define STAYS(k) (epoch_of[k] > epoch_of[node_key])
#endif

inline keep_newer(s) {
	b = 1;
	do
	:: b < KEYS && b != node_key && HOLDS(s, b) && !STAYS(b) -> st[s].held = st[s].held & ~BIT(b); b++
	:: b < KEYS && !(b != node_key && HOLDS(s, b) && !STAYS(b)) -> b++
	:: b >= KEYS -> break
	od;
	b = 0
}

/* A pending key that came back from a backup is not a rotation: it may have been used and shared since. */
#ifdef BREAK_OLD_PENDING
#define MADE_SINCE(s) true
#else
#define MADE_SINCE(s) (node_key >= st[s].due_since)
#endif

proctype station(byte s)
{
	byte b;
#ifdef BREAK_BACK_NO_ROTATION
	bool back;
#endif
end:
	do
	/* -- power goes ------------------------------------------------------------------------------------------- */
	:: atomic { MAY(CUT) && at[s] != idle -> DID(CUT, s); cut(s) }

	/* -- agreement, first or rotation: Request and its reply (128.1), by tap or in a session -------------------- */
	:: atomic { MAY(REQUEST) && UP && at[s] == idle && AGREES(s) && keys < KEYS &&
		(keys > 1 || s == 0) ->	/* who begins makes no difference: stations are alike */
		DID(REQUEST, s);
		assert(OWNS(s));		/* who gave a node away does not agree with it */
		ram = keys; epoch_of[keys] = node_epoch + 1; maker[keys] = s;
		if
		:: NEWER(s, keys) && TO(1) -> AIM(1); fresh[s] = keys; at[s] = replied
		:: TO(0) -> AIM(0)	/* the reply is lost, or its epoch is not newer */
		fi;
		keys++ }
#ifdef BREAK_PENDING
	:: atomic { MAY(SEND_CONFIRM) && at[s] == replied -> DID(SEND_CONFIRM, s); confirm_sent[fresh[s]] = true; at[s] = stored }
	:: atomic { MAY(STORE) && at[s] == stored -> DID(STORE, s); st[s].held = st[s].held | BIT(fresh[s]); at[s] = confirming }
#else
	:: atomic { MAY(STORE) && at[s] == replied ->
		DID(STORE, s);
#ifdef BREAK_EARLY_DELETE
		st[s].held = 0; st[s].present_key = fresh[s];
#endif
#ifdef BREAK_DROP_PENDING
		st[s].held = st[s].held & BIT(st[s].present_key);
#endif
#ifdef BREAK_ROTATED_EARLY
		st[s].due = false; st[s].shared = false; given_to[s] = NOBODY;
#endif
		st[s].held = st[s].held | BIT(fresh[s]); at[s] = stored }
	:: atomic { MAY(SEND_CONFIRM) && at[s] == stored -> DID(SEND_CONFIRM, s); confirm_sent[fresh[s]] = true; at[s] = confirming }
#endif
#ifdef BREAK_BEFORE_OPEN
	:: atomic { MAY(END_CONFIRM) && at[s] == confirming -> DID(END_CONFIRM, s); st[s].held = BIT(fresh[s]); st[s].present_key = fresh[s]; cut(s) }
#endif
	:: atomic { MAY(END_CONFIRM) && at[s] == confirming -> DID(END_CONFIRM, s); cut(s) }	/* the reply came or not: an Open tells */

	/* -- Open under each key held, newest pending first: one succeeds --------------------------------------------- */
	:: atomic { MAY(OPEN) && at[s] == idle && OPENS(s) && (st[s].present_key != node_key || OLDER_HELD(s)) ->
		DID(OPEN, s);
		assert(OWNS(s));			/* who gave a node away does not open a session with it */
		assert(epoch_of[node_key] >= epoch_of[st[s].present_key]);	/* no epoch goes back at a station either */
		st[s].present_key = node_key;
		keep_newer(s);			/* now, and only now, others are deleted */
		if
#ifdef BREAK_ANY_OPEN
		:: true ->
#else
		:: maker[node_key] == s && MADE_SINCE(s) ->
#endif
			st[s].due = false; st[s].shared = false; given_to[s] = NOBODY
#ifndef BREAK_ANY_OPEN
		:: else
#endif
		fi;
		if
		:: node_sequence > st[s].sequence -> st[s].sequence = node_sequence
		:: else
		fi }
	/* 60 seconds after its Request the node has forgotten it: a newer key that did not open goes after all */
	:: atomic { MAY(FORGET) && at[s] == idle && USABLE(s) && st[s].present_key == node_key && st[s].held != BIT(node_key) ->
		DID(FORGET, s);
#ifndef BREAK_NEVER_FORGETS
		if
		:: ram != 0 && HOLDS(s, ram) -> ram = 0
		:: else
		fi;
#endif
		st[s].held = BIT(node_key) }
#ifdef SESSIONS_TOO
	/* -- a session, under the key that the node has now ----------------------------------------------------------- */
	:: atomic { MAY(SESSION) && at[s] == idle && OPENS(s) && !st[s].due && st[s].present_key == node_key && session[s] == 0 ->
		DID(SESSION, s);
		session[s] = node_key }
	:: atomic { MAY(END_SESSION) && session[s] != 0 && at[s] == idle -> DID(END_SESSION, s); session[s] = 0 }
#endif
#ifdef BREAK_REFUSAL
	:: atomic { at[s] == idle && st[s].tombstone == NOBODY && st[s].present_key != 0 && st[s].held != BIT(st[s].present_key) ->
		st[s].held = BIT(st[s].present_key) }	/* "16" to a pending key, perhaps forged */
#endif

	/* -- sign and commit, in a session ---------------------------------------------------------------------------- */
	:: atomic { MAY(SIGN) && at[s] == idle && COMMITS_AS(s) && st[s].present_key == node_key && commits < COMMITS ->
		DID(SIGN, s);
		commits++;
#ifdef BREAK_SIGNER
		st[s].sequence = st[s].sequence + 1;
#else
		st[s].sequence = (st[s].sequence > node_sequence -> st[s].sequence : node_sequence) + 1;
#endif
		assert(st[s].sequence > node_sequence);	/* signed in a session, it is newer than what the node has */
		number[s] = st[s].sequence; fresh[s] = node_key; at[s] = signed_ }
#if defined(BREAK_COMMIT_UNKEYED)
	:: atomic { MAY(COMMIT) && at[s] == signed_ && UP ->
#elif defined(BREAK_GIVEN_COMMIT)
	:: atomic { MAY(COMMIT) && at[s] == signed_ && UP && KNOWN(s) ->
#else
	:: atomic { MAY(COMMIT) && at[s] == signed_ && USABLE(s) ->
#endif
		DID(COMMIT, s);
		assert(number[s] <= node_sequence + STEP);	/* else the node refuses for ever (7) */
		if
#ifdef BREAK_STALE_EPOCH
		:: number[s] > node_sequence ->
#else
		:: number[s] > node_sequence && epoch_of[fresh[s]] == node_epoch ->
#endif
			assert(epoch_of[fresh[s]] == node_epoch);	/* a datasheet is of the epoch that it names */
			assert(number[s] > top_sequence);	/* no sequence goes back */
			assert(HOLDS(s, node_key) && OWNS(s));	/* nobody commits but who has the node */
			node_sequence = number[s]; top_sequence = number[s]
		:: else					/* stale: somebody else was faster; sign again */
		fi;
		done(s) }

	/* -- move: the tombstone before the file ------------------------------------------------------------------------ */
	:: atomic { MAY(MOVE) && at[s] == idle && st[s].tombstone == NOBODY && st[s].present_key != 0 && bundles < BUNDLES &&
		SETTLED(s) && MOVES(s) ->
		DID(MOVE, s);
		select_receiver(s);
		bundle[bundles].sender = s; bundle[bundles].receiver = b; bundle[bundles].key = st[s].present_key;
		bundle[bundles].move = true; bundle[bundles].due = st[s].due; given_to[s] = b;
#ifdef BREAK_MOVE_ORDER
		bundle[bundles].made = true;
#else
		st[s].tombstone = bundles;
#endif
#if defined(SESSIONS_TOO) && !defined(BREAK_MEASURED_ON)
		session[s] = 0;
#endif
		number[s] = bundles; at[s] = given; bundles++ }
#ifdef BREAK_MOVE_ORDER
	:: atomic { MAY(FILE) && at[s] == given -> DID(FILE, s); st[s].tombstone = number[s]; done(s) }
#else
	:: atomic { MAY(FILE) && at[s] == given -> DID(FILE, s); bundle[number[s]].made = true; done(s) }
#endif
	/* cut between the two: the same move again makes the file */
	:: atomic { MAY(FILE_AGAIN) && at[s] == idle && st[s].tombstone != NOBODY && !bundle[st[s].tombstone].made ->
		DID(FILE_AGAIN, s);
#ifdef BREAK_CONTINUED
		select_receiver(s);
		bundle[st[s].tombstone].receiver = b;
#endif
		bundle[st[s].tombstone].made = true }
	/* undo, before the receipt */
#ifdef BREAK_UNDO_CLOSED
	:: atomic { MAY(UNDO) && at[s] == idle && st[s].tombstone != NOBODY ->
#else
	:: atomic { MAY(UNDO) && at[s] == idle && st[s].tombstone != NOBODY && !(st[s].closed & BIT(st[s].tombstone)) ->
#endif
		DID(UNDO, s);
		st[s].undone = st[s].undone | BIT(st[s].tombstone);
		if
		:: !(st[s].closed & BIT(st[s].tombstone)) -> given_to[s] = NOBODY
		:: else
		fi;
#ifndef BREAK_UNDO
		demand_rotation(s);
#endif
		st[s].tombstone = NOBODY }

	/* -- copy: noted before the file ----------------------------------------------------------------------------------- */
	:: atomic { MAY(COPY) && at[s] == idle && st[s].tombstone == NOBODY && st[s].present_key != 0 && COPIES(s) &&
		bundles < BUNDLES ->
		DID(COPY, s);
		select_receiver(s);
		bundle[bundles].sender = s; bundle[bundles].receiver = b; bundle[bundles].key = st[s].present_key;
		bundle[bundles].due = st[s].due;
#ifdef BREAK_COPY_ORDER
		bundle[bundles].made = true; number[s] = bundles; at[s] = given; bundles++ }
	:: atomic { MAY(FILE) && at[s] == given && !bundle[number[s]].move -> DID(FILE, s); st[s].shared = true; done(s) }
#else
		bundle[bundles].made = true; st[s].shared = true; bundles++ }
#endif

	/* -- import, at any time, once: the file may come late, and again after that ------------------------------------- */
	:: atomic { MAY(IMPORT) && TO_NEXT(0) && IMPORTABLE(s, 0) -> DID(IMPORT, s); AIM(0); take_in(s, 0) }
#if BUNDLES > 1
	:: atomic { MAY(IMPORT) && TO_NEXT(1) && IMPORTABLE(s, 1) -> DID(IMPORT, s); AIM(1); take_in(s, 1) }
#endif
#if BUNDLES > 2
	:: atomic { MAY(IMPORT) && TO_NEXT(2) && IMPORTABLE(s, 2) -> DID(IMPORT, s); AIM(2); take_in(s, 2) }
#endif

	/* -- the receipt, at any time --------------------------------------------------------------------------------------- */
	:: atomic { MAY(RECEIPT) && TO_NEXT(0) && RECEIVABLE(s, 0) -> DID(RECEIPT, s); AIM(0); close_handover(s, 0) }
#if BUNDLES > 1
	:: atomic { MAY(RECEIPT) && TO_NEXT(1) && RECEIVABLE(s, 1) -> DID(RECEIPT, s); AIM(1); close_handover(s, 1) }
#endif
#if BUNDLES > 2
	:: atomic { MAY(RECEIPT) && TO_NEXT(2) && RECEIVABLE(s, 2) -> DID(RECEIPT, s); AIM(2); close_handover(s, 2) }
#endif

	/* -- a backup is made; later the store is lost and the backup is all that is left --------------------------------------- */
	:: atomic { MAY(BACKUP) && at[s] == idle && backed_up == NOBODY && RESTORES && st[s].present_key != 0 ->
		DID(BACKUP, s);
		backed_up = s; given_in_backup = given_to[s]; copy(snapshot, st[s]) }
	:: atomic { MAY(RESTORE) && backed_up == s && restores < RESTORES ->
		DID(RESTORE, s);
		restores++; restored = true; cut(s); copy(st[s], snapshot); given_to[s] = given_in_backup;
#ifndef BREAK_M6
		demand_rotation(s)
#endif
		}

	/* -- reset, by hand or in a session: the node forgets its key, never epoch and sequence ------------------------------------ */
	:: atomic { MAY(RESET) && UP && resets < RESETS && node_key != 0 ->
		DID(RESET, s);
		resets++; wiped = node_key; overtaken = ram;
#ifndef BREAK_RESET_KEEPS
		node_key = 0;
#endif
#ifndef BREAK_RESET_RAM
		ram = 0;
#endif
#ifdef BREAK_EPOCH_BACK
		node_epoch = 0;
#endif
#ifdef BREAK_SEQUENCE_BACK
		node_sequence = 0;
#endif
#ifndef BREAK_SESSION_RESET
		END_SESSIONS
#endif
		}
	/* the node signs that it was reset, over the station's challenge of this moment: then its keys go here */
#if defined(BREAK_RESET_REPLAY)
#define SHOWS_RESET (resets > 0)
#elif defined(BREAK_RESET_UNPROVEN)
#define SHOWS_RESET true
#else
#define SHOWS_RESET (UP && resets > 0 && node_key == 0)
#endif
	:: atomic { MAY(PROOF) && SHOWS_RESET && at[s] == idle && st[s].present_key != 0 && st[s].tombstone == NOBODY ->
		DID(PROOF, s);
#if !defined(BREAK_RESET_FACTORY) && !defined(BREAK_RESET_REPLAY) && !defined(BREAK_RESET_UNPROVEN)
		ram = 0;		/* the Reset that brings the proof ends an agreement under way, in factory state too */
#endif
		st[s].held = 0; st[s].present_key = 0 }
	od
}

proctype node()
{
	byte k;
end:
	do
	/* Confirm (128.2): one flash transaction; a doubled or late one finds nothing pending */
#ifdef BREAK_ANY_CONFIRM
	:: atomic { MAY_NODE(CONFIRM) && UP && ram != 0 && (confirm_sent[ram] || confirm_sent[ram - 1]) ->
#else
	:: atomic { MAY_NODE(CONFIRM) && UP && ram != 0 && confirm_sent[ram] ->
#endif
		DID(CONFIRM, 0);
		assert(epoch_of[ram] > top_epoch);	/* no epoch goes back, and none is given twice */
		assert(ram != overtaken);		/* a reset ends what was begun before it */
#ifdef BREAK_KEEPS_OLD
		node_before = node_key;
#endif
#ifdef SLOTS
		if
		:: node_key != 0 -> residue = true; booting = true	/* a cut before the old slot is erased */
		:: skip
		fi;
#endif
#ifndef BREAK_SESSION
		END_SESSIONS;
#endif
		node_key = ram; node_epoch = epoch_of[ram]; top_epoch = node_epoch;
#ifndef BREAK_CONFIRM_TWICE
		ram = 0
#endif
		}
#ifdef SLOTS
	:: atomic { booting ->
#ifndef BREAK_ERASE
		residue = false;
#endif
		booting = false }
#endif
	/* a cut, a lost link, 60 seconds: what lay in RAM is gone */
	:: atomic { MAY_NODE(LOST_RAM) && ram != 0 -> DID(LOST_RAM, 0); ram = 0 }
	od
}

/* A node whose key nobody can use for ever: no living station holds it that may use it or may take it back. */
#define REACHES(s) (HOLDS(s, node_key) && (st[s].tombstone == NOBODY || !(st[s].closed & BIT(st[s].tombstone))))
/* A key left in a file, by its sender's hand or into its receiver's: who uses it still knows that it is not alone. */
#define IN_FILE(s, n) (n < bundles && bundle[n].made && bundle[n].key == node_key && \
	(bundle[n].sender == s || (bundle[n].receiver == s && (st[s].imported & BIT(n)))))
#if BUNDLES > 2
#define LEFT(s) (IN_FILE(s, 0) || IN_FILE(s, 1) || IN_FILE(s, 2))
#elif BUNDLES > 1
#define LEFT(s) (IN_FILE(s, 0) || IN_FILE(s, 1))
#else
#define LEFT(s) IN_FILE(s, 0)
#endif
#define UNAWARE(s) (FREE(s) && !st[s].shared && LEFT(s))
#ifdef SESSIONS_TOO
#define OUTLIVED(s) (session[s] != 0 && (session[s] != node_key || given_to[s] != NOBODY))
#endif
/* Whoever uses a key was not given it by a station that is to rotate it, nor was it carried to two stations by a move. */
#define WAS_DUE(s, n) (n < bundles && bundle[n].due && bundle[n].receiver == s && (st[s].imported & BIT(n)) && \
	bundle[n].key == node_key)
#define ASTRAY(n) (n < bundles && bundle[n].made && bundle[n].move && st[bundle[n].sender].tombstone == n && \
	given_to[bundle[n].sender] != bundle[n].receiver)
#if BUNDLES > 2
#define HAD_DUE(s) (WAS_DUE(s, 0) || WAS_DUE(s, 1) || WAS_DUE(s, 2))
#define ANY_ASTRAY (ASTRAY(0) || ASTRAY(1) || ASTRAY(2))
#elif BUNDLES > 1
#define HAD_DUE(s) (WAS_DUE(s, 0) || WAS_DUE(s, 1))
#define ANY_ASTRAY (ASTRAY(0) || ASTRAY(1))
#else
#define HAD_DUE(s) WAS_DUE(s, 0)
#define ANY_ASTRAY ASTRAY(0)
#endif
#define TWO_OWNERS(x, y) (FREE(x) && FREE(y) && !(st[x].shared && st[y].shared))

#ifdef TRACED
#define TAKES(s, n) if \
	:: IMPORTABLE(s, n) -> able = able | (1 << (3 * n + s)) \
	:: else \
	fi
#define ENTERS(s) if \
	:: at[s] == idle && USABLE(s) -> able = able | (1 << (9 + s)) \
	:: else \
	fi
#ifdef SESSIONS_TOO
#define OPEN_SESSION(s) now.session[s]
#else
#define OPEN_SESSION(s) 0
#endif
#define PRINT(s) printf(" %d:%d:%d:%d:%d:%d:%d:%d", now.st[s].present_key, now.st[s].held, now.st[s].tombstone, \
	now.st[s].due, now.st[s].shared, now.at[s], now.number[s], OPEN_SESSION(s))
#endif

active proctype watch()
{
end:
	do
#ifdef TRACED
	:: atomic { timeout && c_expr { (scripted)(now.turn) } -> refused = true; turn++ }
	:: atomic { printed != turn ->
		TAKES(0, 0); TAKES(1, 0); TAKES(2, 0);
#if BUNDLES > 1
		TAKES(0, 1); TAKES(1, 1); TAKES(2, 1);
#endif
#if BUNDLES > 2
		TAKES(0, 2); TAKES(1, 2); TAKES(2, 2);
#endif
		ENTERS(0); ENTERS(1); ENTERS(2);
		c_code {
			path[now.turn - 1] = now.refused ? 255 : now.last;
			aims[now.turn - 1] = now.aim;
			printf("STATE");
			for (int i = 0; i < now.turn; i++) {
				printf(" %d.%d.%d", path[i] / 4, path[i] % 4, aims[i]);
			}
			printf(" | %d:%d:%d:%d:%d", now.node_key, now.node_epoch, now.node_sequence, now.ram, now.able);
			PRINT(0); PRINT(1); PRINT(2);
			printf("\n");
		};
		able = 0; refused = false; printed = turn }
#endif
	:: atomic { TWO_OWNERS(0, 1) || TWO_OWNERS(0, 2) || TWO_OWNERS(1, 2) -> assert(false) }	/* never two owners without a rotation due */
	:: atomic { (given_to[0] != NOBODY && FREE(0)) || (given_to[1] != NOBODY && FREE(1)) ||
		(given_to[2] != NOBODY && FREE(2)) -> assert(false) }	/* who gave a node away does not use it */
	:: atomic { UNAWARE(0) || UNAWARE(1) || UNAWARE(2) -> assert(false) }	/* who uses a key that left in a file knows of it */
#ifdef SESSIONS_TOO
	:: atomic { OUTLIVED(0) || OUTLIVED(1) || OUTLIVED(2) -> assert(false) }	/* no session outlives its key, or a move */
#endif
	:: atomic { (FREE(0) && HAD_DUE(0)) || (FREE(1) && HAD_DUE(1)) || (FREE(2) && HAD_DUE(2)) -> assert(false) }	/* no key is given to others that its station is to rotate */
	:: atomic { ANY_ASTRAY -> assert(false) }	/* a move's file is for the station that its tombstone names */
	:: atomic { wiped != 0 && node_key == wiped -> assert(false) }	/* what a reset took is no key any more */
#ifdef SLOTS
	:: atomic { !booting && residue -> assert(false) }	/* a node that answers has one key in its flash */
#endif
	:: atomic { node_key != 0 && !restored && !(REACHES(0) || REACHES(1) || REACHES(2)) -> assert(false) }	/* no key is lost */
	od
}

init {
	atomic {
		byte s;
		for (s : 0 .. STATIONS - 1) {
			st[s].tombstone = NOBODY; given_to[s] = NOBODY; at[s] = idle
		}
		s = 0;
		run node(); run station(0); run station(1); run station(2)
	}
}
