/* The plant: rosters of the owner, the chain of pages of one station, two readers, and a registry that carries both.
 *
 * Station 1 writes pages, station 0 is the owner's, station 2 reads. A sync is one step, as only its end is durable for
 * others; between two syncs anything else may happen: homes are lost and come back older, a home is copied by a thief,
 * the registry forgets what it had. A page is its number and a variant (its content); it names the variant before it.
 *
 * Rules that can be broken (spin -DBREAK_GAP ...):
 *   BREAK_RESTORED_WRITES  a restored home publishes before it has looked for its own pages
 *   BREAK_NO_LOOK          a station does not look for pages under its key before it adds to them
 *   BREAK_ADOPT_ANY        a restored home takes pages under its key that do not follow its own
 *   BREAK_PUSH_NEW         a station posts only what it has not posted before: a registry that forgot stays empty
 *   BREAK_GAP              a reader counts a page although one before it is missing
 *   BREAK_PREVIOUS         a reader counts a page that follows another history
 *   BREAK_FORK_UNSEEN      a reader compares numbers of pages only, not their content
 *   BREAK_REMOVED_COUNTS   pages behind the last one that a removal names count
 *   BREAK_REMOVED_WRITES   a station that was removed goes on writing
 *   BREAK_ROSTER_BACK      an older roster takes the place of a newer one
 *   BREAK_OWNER_BLIND      a restored owner signs before it has looked for its own rosters
 *   BREAK_TWO_ROSTERS      two rosters of one version raise no alarm (two homes with the CA key: -DTWO_OWNERS)
 *   BREAK_ROSTER_PREVIOUS  a roster need not follow the one that is held (-DTWO_OWNERS)
 */

#ifndef PAGES
#define PAGES 3
#endif
#define ROSTERS 2
#define EVER 99			/* no removal */
#define HAS(bits, v) ((bits) & (1 << (v)))
#define TWO(bits) ((bits) == 3)
#define VARIANT(history, n) (((history) >> (n)) & 1)
#define FREE_VARIANT(bits) (HAS(bits, 0) -> 1 : 0)
#if defined(BREAK_TWO_ROSTERS) || defined(BREAK_ROSTER_PREVIOUS)
#define TWO_OWNERS
#endif

/* ---- what was signed, and what the registry has of it ----------------------------------------------------------- */
byte page[PAGES + 2], before[2 * PAGES + 4];	/* variants of each page; of each, the variant that it follows */
byte registry[PAGES + 2];
byte roster[ROSTERS + 2], follows[2 * ROSTERS + 4], last[2 * ROSTERS + 4];	/* all of them are in the registry */
bool forgot, stolen;

/* ---- station 1 -------------------------------------------------------------------------------------------------- */
byte own, history;		/* pages, and the variant of each */
byte posted;
bool restored, stopped;
byte own_saved, history_saved, copies;
bool saved;
byte thief, thief_history;

/* ---- rosters and counts of each station ------------------------------------------------------------------------- */
byte version[3], which[3], top[3];
byte counted[3], counts[3];	/* of station 1's pages */
bool alarm[3], alarm_roster[3], fresh[3];
bool owner_restored, owner_saved;
byte version_saved, which_saved, counted_saved, counts_saved;

#define LAST(s) last[2 * version[s] + which[s]]
#define STALE fresh[0] = false; fresh[1] = false; fresh[2] = false
#define FORKED (TWO(registry[1]) || TWO(registry[2]) || TWO(registry[3]))
#define TWO_HELD(s) TWO(roster[version[s]])

/* The next roster that may be taken: one version up, following the one that is held, or a later one. */
#ifdef BREAK_ROSTER_PREVIOUS
#define MAY_FOLLOW(s, n, v) true
#else
#define MAY_FOLLOW(s, n, v) (n != version[s] + 1 || version[s] == 0 || follows[2 * n + v] == which[s])
#endif
#ifdef BREAK_ROSTER_BACK
#define LATER(s, n) (n != version[s])
#else
#define LATER(s, n) (n > version[s])
#endif

inline take(s, n, v) {
	if
	:: HAS(roster[n], v) && LATER(s, n) && MAY_FOLLOW(s, n, v) ->
		assert(n > top[s]);				/* no roster goes back */
		assert(n != version[s] + 1 || version[s] == 0 || follows[2 * n + v] == which[s]);
		version[s] = n; which[s] = v; top[s] = n
	:: else
	fi
}

inline take_rosters(s) {
	take(s, 1, 0); take(s, 1, 1); take(s, 2, 0); take(s, 2, 1);
#ifndef BREAK_TWO_ROSTERS
	if
	:: TWO_HELD(s) -> alarm_roster[s] = true
	:: else
	fi;
#endif
	skip
}

#ifdef BREAK_REMOVED_COUNTS
#define COUNTS(s, n) true
#else
#define COUNTS(s, n) (n <= LAST(s))
#endif
#ifdef BREAK_GAP
#define NEXT(s, n) (n > counted[s])
#else
#define NEXT(s, n) (n == counted[s] + 1)
#endif
#ifdef BREAK_PREVIOUS
#define IN_HISTORY(s, n, v) true
#else
#define IN_HISTORY(s, n, v) (n == 1 || before[2 * n + v] == VARIANT(counts[s], n - 1))
#endif

inline count(s, n, v) {
	if
	:: HAS(registry[n], v) && NEXT(s, n) && IN_HISTORY(s, n, v) && COUNTS(s, n) ->
		assert(n == counted[s] + 1);			/* no page is left out */
		assert(n == 1 || before[2 * n + v] == VARIANT(counts[s], n - 1));	/* one history */
		counted[s] = n; counts[s] = counts[s] | (v << n)
	:: else
	fi
}

/* What a removal leaves out counts no more; the pages are there, and count no longer. */
inline read(s) {
	take_rosters(s);
#ifndef BREAK_REMOVED_COUNTS
	if
	:: version[s] != 0 && counted[s] > LAST(s) -> counted[s] = LAST(s); counts[s] = counts[s] & ((2 << LAST(s)) - 1)
	:: else
	fi;
#endif
	count(s, 1, 0); count(s, 1, 1); count(s, 2, 0); count(s, 2, 1); count(s, 3, 0); count(s, 3, 1);
#ifndef BREAK_FORK_UNSEEN
	if
	:: FORKED -> alarm[s] = true
	:: else
	fi;
#endif
	fresh[s] = true
}

/* -- station 1's own chain: whatever is there under its key is looked at before anything is added to it ------------ */
#define OTHER(n) (n <= own && HAS(registry[n], 1 - VARIANT(history, n)))
#define BEYOND(n) (n > own && registry[n] != 0)
#ifdef BREAK_ADOPT_ANY
#define ADOPTS(n, v) (n > own && HAS(registry[n], v))
#else
#define ADOPTS(n, v) (n == own + 1 && HAS(registry[n], v) && (n == 1 || before[2 * n + v] == VARIANT(history, n - 1)))
#endif

inline adopt(n, v) {
	if
	:: ADOPTS(n, v) ->
		assert(n == own + 1 && (n == 1 || before[2 * n + v] == VARIANT(history, n - 1)));	/* it is its own history */
		own = n; history = history | (v << n)
	:: else
	fi
}

inline look_for_own() {
	if
	:: restored -> adopt(1, 0); adopt(1, 1); adopt(2, 0); adopt(2, 1); adopt(3, 0); adopt(3, 1); restored = false
	:: else
	fi;
	if
	:: OTHER(1) || OTHER(2) || OTHER(3) || BEYOND(1) || BEYOND(2) || BEYOND(3) ->
		assert(stolen);					/* an honest home is never taken for a copy of itself */
		stopped = true
	:: else
	fi
}

#ifdef BREAK_PUSH_NEW
#define POSTS(n) (n <= own && n > posted)
#else
#define POSTS(n) (n <= own)
#endif

inline post(n) {
	if
	:: POSTS(n) && !HAS(registry[n], VARIANT(history, n)) ->
		assert(registry[n] == 0 || stolen);		/* an honest station shows each page once */
		registry[n] = registry[n] | (1 << VARIANT(history, n)); STALE
	:: else
	fi
}

#define REMOVED(s) (version[s] != 0 && LAST(s) != EVER)
#ifdef BREAK_REMOVED_WRITES
#define MEMBER true
#else
#define MEMBER !REMOVED(1)
#endif
#ifdef BREAK_RESTORED_WRITES
#define LOOKED true
#else
#define LOOKED !restored
#endif

active proctype station_1()
{
	byte v;
end:
	do
	:: atomic { own < PAGES && !stopped && LOOKED && MEMBER && version[1] != 0 ->
		assert(!REMOVED(1));				/* who knows of its removal writes nothing */
		if
		:: page[own + 1] != 3 ->
			own++; v = FREE_VARIANT(page[own]); page[own] = page[own] | (1 << v);
			before[2 * own + v] = VARIANT(history, own - 1); history = history | (v << own); v = 0
		:: else
		fi }
	:: atomic { version[1] != 0 || roster[1] != 0 ->	/* sync */
		take_rosters(1);
#ifdef BREAK_NO_LOOK
		restored = false;
#else
		look_for_own();
#endif
		if
		:: !stopped && !REMOVED(1) ->
			post(1); post(2); post(3); posted = own;
			assert(own < 1 || HAS(registry[1], VARIANT(history, 1)));	/* what it wrote is there */
			assert(own < 2 || HAS(registry[2], VARIANT(history, 2)));
			assert(own < 3 || HAS(registry[3], VARIANT(history, 3)))
		:: else
		fi;
		assert(stopped || !FORKED || REMOVED(1)) }	/* it does not go on beside a copy of its home */
	/* its home is saved; lost, it comes back older */
	:: atomic { !saved && own > 0 -> saved = true; own_saved = own; history_saved = history }
	:: atomic { saved && copies == 0 && !forgot ->
		copies++; own = own_saved; history = history_saved; restored = true; stopped = false; posted = own }
	/* a thief has a copy of it as it is now, and writes and posts under its key */
	:: atomic { !stolen && own > 0 && own < PAGES -> stolen = true; thief = own; thief_history = history }
	:: atomic { stolen && thief < PAGES && page[thief + 1] != 3 ->
		thief++; v = FREE_VARIANT(page[thief]); page[thief] = page[thief] | (1 << v);
		before[2 * thief + v] = VARIANT(thief_history, thief - 1); thief_history = thief_history | (v << thief);
		registry[thief] = registry[thief] | (1 << v); v = 0; STALE }
	od
}

#ifdef BREAK_OWNER_BLIND
#define OWNER_LOOKED true
#else
#define OWNER_LOOKED !owner_restored
#endif

active proctype owner()
{
	byte n, v;
end:
	do
	/* sign the next roster: as it was, or station 1 is removed behind the last page that is counted here */
	:: atomic { version[0] < ROSTERS && OWNER_LOOKED ->
		n = version[0] + 1;
#ifdef TWO_OWNERS
		if
		:: roster[n] == 3 -> n = 0
		:: else
		fi;
#else
		assert(roster[n] == 0);				/* an owner signs each version once */
#endif
		if
		:: n != 0 && roster[n] != 3 ->
			v = FREE_VARIANT(roster[n]);
			if
			:: version[0] != 0 && LAST(0) != EVER -> last[2 * n + v] = LAST(0)
			:: version[0] == 0 || LAST(0) == EVER -> last[2 * n + v] = EVER
			:: version[0] != 0 && LAST(0) == EVER -> last[2 * n + v] = counted[0]
			fi;
			roster[n] = roster[n] | (1 << v); follows[2 * n + v] = which[0];
#ifdef TWO_OWNERS
			if
			:: version[0] = n; which[0] = v; top[0] = n
			:: skip				/* the other home with the CA key has signed it */
			fi;
#else
			version[0] = n; which[0] = v; top[0] = n;
#endif
			STALE
		:: else
		fi;
		n = 0; v = 0 }
	:: atomic { !fresh[0] && roster[1] != 0 -> owner_restored = false; read(0) }
	:: atomic { !owner_saved && version[0] != 0 ->
		owner_saved = true; version_saved = version[0]; which_saved = which[0];
		counted_saved = counted[0]; counts_saved = counts[0] }
	:: atomic { owner_saved && copies == 0 ->
		copies++; version[0] = version_saved; which[0] = which_saved; counted[0] = counted_saved;
		counts[0] = counts_saved; top[0] = version_saved; fresh[0] = false; owner_restored = true }
	od
}

active proctype reader()
{
end:
	do
	:: atomic { !fresh[2] && roster[1] != 0 -> read(2) }
	od
}

/* The registry loses its last page; its station has it, unless that was lost with its home. */
active proctype forgetful()
{
end:
	do
	:: atomic { !forgot && copies == 0 && registry[1] != 0 && registry[2] == 0 -> forgot = true; copies = 1; registry[1] = 0; STALE }
	:: atomic { !forgot && copies == 0 && registry[2] != 0 && registry[3] == 0 -> forgot = true; copies = 1; registry[2] = 0; STALE }
	od
}

active proctype watch()
{
end:
	do
	:: atomic { (fresh[0] && FORKED && !alarm[0]) || (fresh[2] && FORKED && !alarm[2]) -> assert(false) }	/* a fork is noticed */
	:: atomic { (fresh[0] && version[0] != 0 && counted[0] > LAST(0)) ||
		(fresh[2] && version[2] != 0 && counted[2] > LAST(2)) -> assert(false) }	/* nothing counts behind a removal */
	:: atomic { (fresh[0] && TWO_HELD(0) && !alarm_roster[0]) || (fresh[2] && TWO_HELD(2) && !alarm_roster[2]) -> assert(false) }	/* two rosters of one version are noticed */
	od
}
