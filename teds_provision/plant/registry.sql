-- registry/2. A post office: it carries signed pages and sealed parcels and decides nothing. `registry sql` prints this, with :registry filled in,
-- as one transaction; it may be run again at any time (after a pg_restore it must be). Run it as a superuser in a database of its own: a mere owner gets
-- warnings, and the last revokes do not take (measured). What members may call belongs to teds_owner, who is no superuser and cannot log in.
-- A member may hold locks as long as it likes: its open transactions end first, and again until every table is ours.
begin;
set local lock_timeout = '500ms';
do $$ declare attempt int; part text; begin
  for attempt in 1..20 loop
    perform pg_stat_clear_snapshot();
    perform pg_terminate_backend(a.pid, 2000) from pg_stat_activity a join pg_auth_members x on x.member = a.usesysid
      join pg_roles r on r.oid = x.roleid and r.rolname = 'teds_member' where a.xact_start is not null;
    begin
      for part in select oid::regclass from pg_class where relnamespace = (select oid from pg_namespace where nspname = 'registry') and relkind = 'r' loop
        execute format('lock table %s in access exclusive mode', part); end loop;
      exit;
    exception when lock_not_available then if attempt = 20 then raise; end if; end;
  end loop; end $$;
revoke all on schema public from public;
do $$ begin execute format('revoke all on database %I from public', current_database()); -- no TEMP, no CONNECT
  if not exists (select from pg_roles where rolname = 'teds_member') then create role teds_member nologin; end if;
  if not exists (select from pg_roles where rolname = 'teds_reader') then create role teds_reader nologin; end if;
  if not exists (select from pg_roles where rolname = 'teds_owner') then create role teds_owner nologin; end if;
  if not exists (select from pg_roles where rolname = 'teds_sweeper') then create role teds_sweeper nologin; end if;
  execute format('grant connect on database %I to teds_member, teds_reader', current_database()); end $$;
create schema if not exists registry authorization teds_owner;
grant execute on function pg_catalog.pg_notify(text, text) to teds_owner;
revoke usage on language plpgsql from public; -- no DO block: a loop of a member's own takes locks, subtransactions and NOTIFY as fast as the server can
grant usage on language plpgsql to teds_owner;
drop function if exists registry.sweep(); -- it is not teds_owner's, who could not revoke it below
set local role teds_owner;
grant usage on schema registry to teds_member, teds_reader;
create table if not exists registry.meta (one bool primary key default true check (one), version int not null, registry uuid not null);
insert into registry.meta(version, registry) values (2, :'registry') on conflict do nothing;
do $$ begin if (select version from registry.meta) > 2 then raise exception 'this is schema %, newer than 2', (select version from registry.meta); end if; end $$;
create table if not exists registry.member (role name primary key, station bytea not null unique check (length(station) = 32), open boolean not null default true,
  n int not null default 0, hash bytea not null default '\x', at timestamptz);
-- the newest roster that each member knows: nobody can take a version's place, and one that was rolled back is put back by whoever has it
create table if not exists registry.roster (station bytea primary key references registry.member(station), version int not null check (version > 0),
  jws text not null check (octet_length(jws) <= 1048576));
create table if not exists registry.page (station bytea not null references registry.member(station), n int not null check (n > 0), hash bytea not null,
  jws text not null check (octet_length(jws) between 100 and 1048576), received timestamptz not null default now(), primary key (station, n));
create table if not exists registry.parcel (id uuid primary key, recipient bytea not null references registry.member(station), sender bytea not null,
  document bytea not null check (octet_length(document) <= 67108864), expires timestamptz not null, received timestamptz not null default now());
-- since schema 2: pages of stations that are no open member (removed, or their row was lost), handed in by members (`by`). One row for each who hands in,
-- so that a page with a forged signature (the same H) keeps nobody's page out. `handed` counts them: a member's limit, and what is new at one look.
create table if not exists registry.found (author bytea not null check (length(author) = 32), n int not null check (n > 0), hash bytea not null,
  jws text not null check (octet_length(jws) between 100 and 1048576), by bytea not null, received timestamptz not null default now(), primary key (author, by, n, hash));
create table if not exists registry.handed (author bytea not null, by bytea not null, pages int not null, octets bigint not null, at timestamptz not null,
  primary key (by, author));
update registry.meta set version = 2 where version = 1;
create index if not exists parcel_to on registry.parcel (recipient);
create index if not exists parcel_from on registry.parcel (sender);
create or replace function registry.me() returns bytea language sql stable security definer set search_path = pg_catalog, pg_temp
  as $$ select station from registry.member where role = session_user and open $$;
create or replace function registry.append(wanted int, previous bytea, page text) returns int language plpgsql security definer set search_path = pg_catalog, pg_temp as $$
declare m registry.member; h bytea := sha256(convert_to(left(page, length(page) - position('.' in reverse(page))), 'UTF8')); begin
  if current_setting('transaction_isolation') <> 'read committed' then raise exception 'isolation' using errcode = 'TE005'; end if;
  select * into m from registry.member where role = session_user and open for no key update;
  if not found then raise exception 'not a member' using errcode = 'TE001'; end if;
  if wanted <= m.n then
    if exists (select from registry.page p where p.station = m.station and p.n = wanted and p.hash = h) then return m.n; end if; -- the same page again
    raise exception 'fork: another page % of this station is here', wanted using errcode = 'TE002'; end if;
  if wanted > m.n + 1 then raise exception 'gap: the registry has % pages of this station', m.n using errcode = 'TE003'; end if;
  if previous is distinct from m.hash then raise exception 'fork: page % does not follow', wanted using errcode = 'TE002'; end if;
  insert into registry.page(station, n, hash, jws) values (m.station, wanted, h, page);
  update registry.member set n = wanted, at = now(), hash = h where role = session_user;
  perform pg_notify('teds', encode(m.station, 'hex') || ' ' || wanted);
  return wanted; end $$;
create or replace function registry.restore(fingerprint bytea, number int, page text) returns boolean language plpgsql security definer set search_path = pg_catalog, pg_temp as $$
declare who bytea; h bytea := sha256(convert_to(left(page, length(page) - position('.' in reverse(page))), 'UTF8')); kept bigint; begin
  if current_setting('transaction_isolation') <> 'read committed' then raise exception 'isolation' using errcode = 'TE005'; end if;
  select m.station into who from registry.member m where m.role = session_user and m.open for no key update; -- one at a time: the limit is exact
  if not found then raise exception 'not a member' using errcode = 'TE001'; end if;
  if exists (select from registry.member m where m.station = fingerprint and m.open) then
    raise exception 'its author is an open member and appends its own pages' using errcode = 'TE006'; end if;
  if exists (select from registry.page p where p.station = fingerprint and p.n = number and p.jws = page)
    or exists (select from registry.found f where f.author = fingerprint and f.n = number and f.hash = h and f.jws = page)
    or exists (select from registry.found f where f.author = fingerprint and f.by = who and f.n = number and f.hash = h) then return false; end if;
  select coalesce(sum(x.octets), 0) into kept from registry.handed x where x.by = who;
  if kept + greatest(octet_length(page), 1024) > 67108864 then raise exception 'this member has handed in 64 MiB' using errcode = 'TE004'; end if;
  insert into registry.found(author, n, hash, jws, by) values (fingerprint, number, h, page, who);
  insert into registry.handed as x (author, by, pages, octets, at) values (fingerprint, who, 1, greatest(octet_length(page), 1024), clock_timestamp())
    on conflict (by, author) do update set pages = x.pages + 1, octets = x.octets + greatest(octet_length(page), 1024), at = clock_timestamp();
  if (select x.pages from registry.handed x where x.by = who and x.author = fingerprint) = 1 then
    perform pg_notify('teds', encode(fingerprint, 'hex') || ' ' || number); end if; -- the first wakes; the others are seen by the look each 60 s
  return true; end $$;
create or replace function registry.post_roster(number int, document text) returns void language plpgsql security definer set search_path = pg_catalog, pg_temp as $$
declare who bytea := registry.me(); begin
  if who is null then raise exception 'not a member' using errcode = 'TE001'; end if;
  insert into registry.roster as r (station, version, jws) values (who, number, document)
    on conflict (station) do update set version = excluded.version, jws = excluded.jws;
  perform pg_notify('teds', 'roster ' || number); end $$;
create or replace function registry.send(parcel uuid, receiver bytea, content bytea, until timestamptz) returns void language plpgsql security definer set search_path = pg_catalog, pg_temp as $$
declare who bytea; waiting bigint; begin
  select m.station into who from registry.member m where m.role = session_user and m.open for no key update; -- one at a time: the limit is exact
  if not found then raise exception 'not a member' using errcode = 'TE001'; end if;
  if until > now() + interval '31 days' then raise exception 'too long' using errcode = 'TE004'; end if;
  delete from registry.parcel where expires < now() and sender = who;
  -- a parcel counts for 16 KiB at least: not even empty ones keep a receiver busy for long
  select coalesce(sum(greatest(octet_length(document), 16384)), 0) into waiting from registry.parcel where sender = who;
  if waiting + greatest(octet_length(content), 16384) > 268435456 then raise exception 'too much waits' using errcode = 'TE004'; end if;
  insert into registry.parcel(id, recipient, sender, document, expires) values (parcel, receiver, who, content, until);
  perform pg_notify('teds', 'parcel ' || encode(receiver, 'hex')); end $$;
alter table registry.parcel enable row level security;
drop policy if exists mine on registry.parcel;
drop policy if exists gone on registry.parcel;
create policy mine on registry.parcel for select using ((select registry.me()) in (recipient, sender));
create policy gone on registry.parcel for delete using ((select registry.me()) in (recipient, sender));
revoke all on all tables in schema registry from public, teds_member, teds_reader;
revoke all on all functions in schema registry from public;
grant execute on function registry.append(int, bytea, text), registry.restore(bytea, int, text), registry.post_roster(int, text), registry.send(uuid, bytea, bytea, timestamptz), registry.me() to teds_member;
grant select on registry.page, registry.member, registry.roster, registry.meta, registry.parcel, registry.found, registry.handed to teds_member;
grant delete on registry.parcel to teds_member;
grant select on registry.page, registry.member, registry.roster, registry.meta, registry.found, registry.handed to teds_reader;
reset role;
-- what every login may do by default and a thief would like
do $$ declare f regprocedure; begin
  for f in select oid::regprocedure from pg_proc where pronamespace = 'pg_catalog'::regnamespace
    and (proname ~ '^pg_(try_)?advisory_' or proname ~ '^(lo_(creat|create|from_bytea|put|truncate|truncate64|import|open)|lowrite)$' or proname in ('pg_notify', 'pg_export_snapshot', 'pg_logical_emit_message')) loop
    execute format('revoke execute on function %s from public', f); end loop; end $$;
-- Settings of a login are only defaults, which it may change, but for temp_file_limit. So members hold each other to the limits: sweep(), which each of them
-- calls now and then, ends a member's transaction that is older than two minutes (a statement of ours takes 60 s at most), or than ten seconds while the
-- queue of notifications fills (one that listens keeps it from being emptied), or that holds more than 1,000 locks.
create or replace function registry.sweep() returns int language sql security definer set search_path = pg_catalog, pg_temp as $$
  select count(*) filter (where pg_terminate_backend(a.pid))::int from pg_stat_activity a
    where a.pid <> pg_backend_pid() and a.usesysid in (select x.member from pg_auth_members x join pg_roles r on r.oid = x.roleid where r.rolname = 'teds_member')
      and (a.xact_start < clock_timestamp() - interval '120 seconds'
        or (pg_notification_queue_usage() > 0.1 and a.xact_start < clock_timestamp() - interval '10 seconds') or (select count(*) from pg_locks l where l.pid = a.pid) > 1000) $$;
alter function registry.sweep() owner to teds_sweeper;
grant pg_signal_backend, pg_read_all_stats to teds_sweeper;
revoke all on function registry.sweep() from public;
grant execute on function registry.sweep() to teds_member;
do $$ declare login name; begin
  for login in select m.role from registry.member m join pg_roles r on r.rolname = m.role loop
    execute format('alter role %I connection limit 6', login);
    execute format('alter role %I set temp_file_limit = %L', login, '512MB');
    execute format('alter role %I set statement_timeout = %L', login, '60s');
    execute format('alter role %I set idle_in_transaction_session_timeout = %L', login, '60s'); end loop; end $$;
commit;
