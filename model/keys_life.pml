/* The life of a node's link key: agreement, rotation, commit, handover by copy and move, receipt, undo, restore, reset.
 *
 * One node, three stations that one CA certified. Every option of a process is one durable step (one transaction of the
 * store, or of the node's flash) or one message; between any two of them anything else may happen, and a station or the
 * node may be cut. Messages are lost (the step behind them does not happen), delayed (a Confirm, a bundle or a receipt
 * arrives at any later time) and doubled (it may arrive again). model/README.md maps each step to the code and says what
 * is left out.
 *
 * Rules that can be broken to see that the model notices (spin -DBREAK_M2 ...):
 *   BREAK_M1      the sequence of a bundle is taken for true
 *   BREAK_M2      any trusted station lifts a tombstone, and no rotation is due after it
 *   BREAK_M3      a move exports the active key while an agreement is unsettled, and its receipt deletes every key
 *   BREAK_M6      a store brought back from a backup is used as if nothing had happened since
 *   BREAK_PENDING the new key is stored after Confirm left, not before
 *   BREAK_HELD_BACK  an Open under the old key deletes the new one, whose Confirm was held back on the way
 *   BREAK_OLD_PENDING  any pending key that opens ends a due rotation, also one made before the rotation was due
 *   BREAK_REFUSAL a refused Open deletes the key that was tried
 *   BREAK_LATE    a late receipt deletes the key though the node has come back since
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

/* ---- the node ------------------------------------------------------------------------------------------------- */
byte node_key, node_epoch, node_sequence;
byte ram;			/* the key that a good Request left in RAM */

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
byte fresh[STATIONS];		/* the key of the agreement under way */
byte number[STATIONS];		/* the sequence being written, or the bundle being made */

/* ---- bundles ---------------------------------------------------------------------------------------------------- */
typedef Bundle { byte sender; byte receiver; byte key; bool move; bool made; bool receipt }
Bundle bundle[BUNDLES];
byte bundles;

/* ---- for the properties alone ----------------------------------------------------------------------------------- */
byte given_to[STATIONS];	/* to whom it gave the node, until it is handed back, undone or rotated away */
bool restored;			/* a store was lost and came back older: keys may be gone (docs/profile.md, "What a cut leaves behind") */
byte commits, restores, resets;

#define HOLDS(s, k) ((k) != 0 && (st[s].held & BIT(k)))
#define USABLE(s) (st[s].tombstone == NOBODY && HOLDS(s, node_key))
#define FREE(s) (USABLE(s) && !st[s].due)

inline cut(s) { at[s] = idle; fresh[s] = 0; number[s] = 0 }

inline demand_rotation(s) { st[s].due = true; st[s].due_since = keys }

#ifdef BREAK_M3
#define SETTLED(s) true
#else
#define SETTLED(s) (st[s].held == BIT(st[s].present_key))
#endif

inline select_receiver(s) {
	if
	:: s != 0 -> b = 0
	:: s != 1 -> b = 1
	:: s != 2 -> b = 2
	fi
}

/* No epoch goes back; and after a move only the station that the node went to may hand it back. */
#define NOT_OLDER(s, n) (st[s].present_key == 0 || epoch_of[bundle[n].key] >= epoch_of[st[s].present_key])
#define HANDED_BACK(s, n) (bundle[n].move && bundle[n].sender == bundle[st[s].tombstone].receiver)
#ifdef BREAK_M2
#define MAY_COME(s, n) true
#else
#define MAY_COME(s, n) (st[s].tombstone == NOBODY || HANDED_BACK(s, n))
#endif
#define IMPORTABLE(s, n) (at[s] == idle && n < bundles && bundle[n].made && bundle[n].receiver == s && \
	!(st[s].imported & BIT(n)) && NOT_OLDER(s, n) && MAY_COME(s, n))

inline take_in(s, n) {
	if
	:: st[s].tombstone != NOBODY ->
		if
		:: HANDED_BACK(s, n) -> given_to[s] = NOBODY
		:: else
		fi;
#ifndef BREAK_M2
		demand_rotation(s);
#endif
		st[s].tombstone = NOBODY
	:: else
	fi;
	if
	:: bundle[n].move -> demand_rotation(s)
	:: else -> st[s].shared = true
	fi;
#ifdef BREAK_M1
	st[s].sequence = LIE;
#endif
	st[s].held = st[s].held | BIT(bundle[n].key);
	st[s].imported = st[s].imported | BIT(n);
	bundle[n].receipt = true
}

#define RECEIVABLE(s, n) (at[s] == idle && n < bundles && bundle[n].sender == s && bundle[n].receipt && \
	!(st[s].closed & BIT(n)))

inline close_handover(s, n) {
	st[s].closed = st[s].closed | BIT(n);
	if
#ifdef BREAK_LATE
	:: bundle[n].move && !(st[s].undone & BIT(n)) ->
#else
	:: bundle[n].move && st[s].tombstone == n ->	/* only while this very move stands */
#endif
#ifdef BREAK_M3
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

inline copy(to, from) {
	to.present_key = from.present_key; to.held = from.held; to.sequence = from.sequence; to.tombstone = from.tombstone;
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
end:
	do
	/* -- power goes ------------------------------------------------------------------------------------------- */
	:: atomic { at[s] != idle -> cut(s) }

	/* -- agreement, first or rotation: Request and its reply (128.1), by tap or in a session -------------------- */
	:: atomic { at[s] == idle && st[s].tombstone == NOBODY && keys < KEYS &&
		(keys > 1 || s == 0) ->	/* who begins makes no difference: stations are alike */
		ram = keys; epoch_of[keys] = node_epoch + 1; maker[keys] = s;
		if
		:: epoch_of[keys] > epoch_of[st[s].present_key] -> fresh[s] = keys; at[s] = replied
		:: skip			/* the reply is lost, or its epoch is not newer */
		fi;
		keys++ }
#ifdef BREAK_PENDING
	:: atomic { at[s] == replied -> confirm_sent[fresh[s]] = true; at[s] = stored }
	:: atomic { at[s] == stored -> st[s].held = st[s].held | BIT(fresh[s]); at[s] = confirming }
#else
	:: atomic { at[s] == replied -> st[s].held = st[s].held | BIT(fresh[s]); at[s] = stored }
	:: atomic { at[s] == stored -> confirm_sent[fresh[s]] = true; at[s] = confirming }
#endif
	:: atomic { at[s] == confirming -> cut(s) }	/* the reply came or not: an Open tells */

	/* -- Open under each key held, newest pending first: one succeeds --------------------------------------------- */
	:: atomic { at[s] == idle && USABLE(s) && (st[s].present_key != node_key || OLDER_HELD(s)) ->
		st[s].present_key = node_key;
		keep_newer(s);			/* now, and only now, others are deleted */
		if
		:: maker[node_key] == s && MADE_SINCE(s) ->
			st[s].due = false; st[s].shared = false; given_to[s] = NOBODY
		:: else
		fi;
		if
		:: node_sequence > st[s].sequence -> st[s].sequence = node_sequence
		:: else
		fi }
	/* 60 seconds after its Request the node has forgotten it: a newer key that did not open goes after all */
	:: atomic { at[s] == idle && USABLE(s) && st[s].present_key == node_key && st[s].held != BIT(node_key) ->
		if
		:: ram != 0 && HOLDS(s, ram) -> ram = 0
		:: else
		fi;
		st[s].held = BIT(node_key) }
#ifdef BREAK_REFUSAL
	:: atomic { at[s] == idle && st[s].tombstone == NOBODY && st[s].present_key != 0 && st[s].held != BIT(st[s].present_key) ->
		st[s].held = BIT(st[s].present_key) }	/* "16" to a pending key, perhaps forged */
#endif

	/* -- sign and commit, in a session ---------------------------------------------------------------------------- */
	:: atomic { at[s] == idle && FREE(s) && st[s].present_key == node_key && commits < COMMITS ->
		commits++;
		st[s].sequence = (st[s].sequence > node_sequence -> st[s].sequence : node_sequence) + 1;
		number[s] = st[s].sequence; at[s] = signed_ }
	:: atomic { at[s] == signed_ && USABLE(s) ->
		assert(number[s] <= node_sequence + STEP);	/* else the node refuses for ever (7) */
		if
		:: number[s] > node_sequence -> node_sequence = number[s]
		:: else					/* stale: somebody else was faster; sign again */
		fi;
		cut(s) }

	/* -- move: the tombstone before the file ------------------------------------------------------------------------ */
	:: atomic { at[s] == idle && st[s].tombstone == NOBODY && st[s].present_key != 0 && bundles < BUNDLES && SETTLED(s) ->
		select_receiver(s);
		bundle[bundles].sender = s; bundle[bundles].receiver = b; bundle[bundles].key = st[s].present_key;
		bundle[bundles].move = true;
		st[s].tombstone = bundles; given_to[s] = b; number[s] = bundles; at[s] = given; bundles++ }
	:: atomic { at[s] == given -> bundle[number[s]].made = true; cut(s) }
	/* cut between the two: the same move again makes the file */
	:: atomic { at[s] == idle && st[s].tombstone != NOBODY && !bundle[st[s].tombstone].made ->
		bundle[st[s].tombstone].made = true }
	/* undo, before the receipt */
	:: atomic { at[s] == idle && st[s].tombstone != NOBODY && !(st[s].closed & BIT(st[s].tombstone)) ->
		st[s].undone = st[s].undone | BIT(st[s].tombstone);
		st[s].tombstone = NOBODY; demand_rotation(s); given_to[s] = NOBODY }

	/* -- copy: noted before the file ----------------------------------------------------------------------------------- */
	:: atomic { at[s] == idle && st[s].tombstone == NOBODY && st[s].present_key != 0 && !st[s].due && bundles < BUNDLES &&
		st[s].held == BIT(st[s].present_key) ->
		select_receiver(s);
		bundle[bundles].sender = s; bundle[bundles].receiver = b; bundle[bundles].key = st[s].present_key;
		bundle[bundles].made = true; st[s].shared = true; bundles++ }

	/* -- import, at any time, once: the file may come late, and again after that ------------------------------------- */
	:: atomic { IMPORTABLE(s, 0) -> take_in(s, 0) }
#if BUNDLES > 1
	:: atomic { IMPORTABLE(s, 1) -> take_in(s, 1) }
#endif
#if BUNDLES > 2
	:: atomic { IMPORTABLE(s, 2) -> take_in(s, 2) }
#endif

	/* -- the receipt, at any time --------------------------------------------------------------------------------------- */
	:: atomic { RECEIVABLE(s, 0) -> close_handover(s, 0) }
#if BUNDLES > 1
	:: atomic { RECEIVABLE(s, 1) -> close_handover(s, 1) }
#endif
#if BUNDLES > 2
	:: atomic { RECEIVABLE(s, 2) -> close_handover(s, 2) }
#endif

	/* -- a backup is made; later the store is lost and the backup is all that is left --------------------------------------- */
	:: atomic { at[s] == idle && backed_up == NOBODY && RESTORES && st[s].present_key != 0 ->
		backed_up = s; copy(snapshot, st[s]) }
	:: atomic { backed_up == s && restores < RESTORES ->
		restores++; restored = true; cut(s); copy(st[s], snapshot);
#ifndef BREAK_M6
		demand_rotation(s)
#endif
		}

	/* -- reset, by hand or in a session: the node forgets its key, never epoch and sequence ------------------------------------ */
	:: atomic { resets < RESETS && node_key != 0 -> resets++; node_key = 0; ram = 0 }
	od
}

proctype node()
{
	byte k;
end:
	do
	/* Confirm (128.2): one flash transaction; a doubled or late one finds nothing pending */
	:: atomic { ram != 0 && confirm_sent[ram] ->
		assert(epoch_of[ram] > node_epoch);	/* no epoch goes back */
		node_key = ram; node_epoch = epoch_of[ram]; ram = 0 }
	/* a cut, a lost link, 60 seconds: what lay in RAM is gone */
	:: atomic { ram != 0 -> ram = 0 }
	od
}

/* A node whose key nobody can use for ever: no living station holds it that may use it or may take it back. */
#define REACHES(s) (HOLDS(s, node_key) && (st[s].tombstone == NOBODY || !(st[s].closed & BIT(st[s].tombstone))))
#define TWO_OWNERS(x, y) (FREE(x) && FREE(y) && !(st[x].shared && st[y].shared))

active proctype watch()
{
end:
	do
	:: atomic { TWO_OWNERS(0, 1) || TWO_OWNERS(0, 2) || TWO_OWNERS(1, 2) -> assert(false) }	/* never two owners without a rotation due */
	:: atomic { (given_to[0] != NOBODY && FREE(0)) || (given_to[1] != NOBODY && FREE(1)) ||
		(given_to[2] != NOBODY && FREE(2)) -> assert(false) }	/* who gave a node away does not use it */
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
