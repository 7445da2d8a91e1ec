/* SPDX-License-Identifier: Apache-2.0 */
/* Streams (operation.md, 3, 4): Subscribe, Stop, taking samples when due, data messages sealed and cut into frames. A
 * stream has one message being filled and one waiting; when the next one is full, the waiting one is dropped: newest
 * wins. One message is sent at a time. */
#include "stream.h"
#include "clock.h"
#include "isotp.h"
#include "session.h"
#include "transducers.h"
#include "inside.h"

#if TEDS_OPERATION

#define LONGEST_PERIOD UINT64_C(1000000000000)
#define LATEST_START (60u * TEDS_SECOND)
#define SOON_NS (30u * UINT64_C(1000000))
#define AFTER_MARK_NS (10u * UINT64_C(1000000))
#define WAITS UINT64_MAX
#define ASLEEP_NS (150u * UINT64_C(1000000))
#define MICRO 1000u
#define MILLION 1000000u
#define DATA 0x1CFF0000u
#define PATTERN 0x80u
#define BLE_DATA_HEAD 4u /* ATT's three octets, and the stream */
enum { PERIODIC = 0, EVENT = 1, FREE = 2 };

typedef struct asked {
    uint8_t stream, kind, pattern, n, count, octets;
    uint16_t gap;
    uint64_t period, start;
    uint8_t places[16];
} asked;

static uint64_t message_span(const teds_stream *stream)
{
    return stream->n * stream->period;
}

/* Over BLE a message is one notification. */
static uint64_t count_frames(uint32_t length, bool fd, bool ble)
{
    uint32_t room = fd ? 64 : 8;
    return ble ? 1 : (length + room - 1) / room;
}

static uint64_t share_of_bus(uint64_t count, uint64_t gap, uint64_t instants)
{
    return (count * gap * TEDS_SECOND + instants - 1) / instants;
}

static teds_stream *find_stream(teds_node *node, const teds_session *session, uint8_t number)
{
    for (teds_stream *each = node->streams; each < node->streams + TEDS_STREAMS; each++) {
        if (each->used && each->session == session && each->number == number) {
            return each;
        }
    }
    return NULL;
}

static void end_stream(teds_node *node, teds_stream *stream)
{
    node->missed += stream->missed;
    if (node->can.data_stream == stream) {
        node->can.data_stream = NULL; /* its unsent frames are withdrawn */
    }
    teds_wipe(stream, sizeof *stream);
}

bool teds_streams_running(const teds_node *node)
{
    for (const teds_stream *each = node->streams; each < node->streams + TEDS_STREAMS; each++) {
        if (each->used) {
            return true;
        }
    }
    return false;
}

void teds_streams_end(teds_node *node, teds_session *session, uint32_t places)
{
    for (teds_stream *each = node->streams; each < node->streams + TEDS_STREAMS; each++) {
        bool touched = false;
        for (size_t c = 0; each->used && c < each->count; c++) {
            touched = touched || (places >> each->channels[c] & 1) != 0;
        }
        if (each->used && each->session == session && touched) {
            end_stream(node, each);
        }
    }
}

void teds_streams_ready(teds_node *node, teds_session *session)
{
    for (teds_stream *each = node->streams; each < node->streams + TEDS_STREAMS; each++) {
        if (each->used && each->session == session) {
            each->ready = true;
        }
    }
}

void teds_streams_start(teds_node *node, const teds_session *session, uint64_t tick)
{
    for (teds_stream *each = node->streams; each < node->streams + TEDS_STREAMS; each++) {
        if (each->used && each->session == session && each->waits) {
            each->waits = false;
            each->start = tick + AFTER_MARK_NS;
        }
    }
}

/* -- Subscribe ----------------------------------------------------------------------------------------------------- */

static int read_asked(const teds_command *command, asked *out)
{
    const uint8_t *payload = command->payload;
    int refused;
    memset(out, 0, sizeof *out);
    if (command->length <= 21) {
        return -TEDS_BAD_FORM;
    }
    refused = teds_channel_list(payload + 21, command->length - 21, 16);
    out->stream = payload[0];
    out->kind = payload[1] & 0x7F;
    out->pattern = payload[1] & PATTERN;
    out->n = payload[2];
    out->gap = teds_get16(payload + 3);
    out->period = teds_get64(payload + 5);
    out->start = teds_get64(payload + 13);
    out->count = (uint8_t)(command->length - 21);
    if (refused || out->stream > 3 || out->kind > FREE || out->n == 0) {
        return -TEDS_BAD_FORM;
    }
    return out->kind == EVENT && (out->n != 1 || out->count != 1) ? -TEDS_BAD_FORM : 0;
}

static int check_channels(const teds_node *node, const teds_command *command, const teds_origin *origin, asked *in)
{
    uint32_t octets = 0;
    bool acts = false, events = false, others = false;
    for (size_t i = 0; i < in->count; i++) {
        int place = teds_place_of(node, command->payload[21 + i]);
        if (place < 0 || (origin->session->claims >> place & 1) == 0) {
            return -TEDS_WRONG_STATE;
        }
        in->places[i] = (uint8_t)place;
        octets += node->port->channels[place].octets;
        acts = acts || node->port->channels[place].kind == TEDS_ACTUATOR;
        events = events || node->port->channels[place].kind == TEDS_EVENT_SENSOR;
        others = others || node->port->channels[place].kind == TEDS_SENSOR;
    }
    in->octets = (uint8_t)(octets < 255 ? octets : 255);
    if (acts) {
        return -TEDS_NOT_PERMITTED;
    }
    return (in->kind == EVENT ? others : events) ? -TEDS_OUT_OF_RANGE : 0;
}

static int check_period(const teds_node *node, const asked *in)
{
    uint64_t shortest = 1, stated;
    for (size_t i = 0; i < in->count; i++) {
        uint64_t own = node->port->channels[in->places[i]].shortest;
        (void)teds_channel_fits(node, in->places[i], &stated);
        shortest = own > shortest ? own : shortest;
        shortest = stated > shortest ? stated : shortest;
    }
    return in->period < shortest || in->period > LONGEST_PERIOD ? -TEDS_OUT_OF_RANGE : 0;
}

static bool is_on_bus(const teds_stream *stream, bool ble)
{
    return stream->used && stream->ble == ble;
}

/* Check the node's budget on the bus, with one more stream in place of `old`. */
static int check_budget(const teds_node *node, const asked *in, uint64_t count, bool ble, const teds_stream *old)
{
    uint64_t gap = in->gap > 0 ? in->gap : 1, sum = 0;
    for (const teds_stream *each = node->streams; each < node->streams + TEDS_STREAMS; each++) {
        if (is_on_bus(each, ble) && each != old && each->gap > gap) {
            gap = each->gap;
        }
    }
    for (const teds_stream *each = node->streams; each < node->streams + TEDS_STREAMS; each++) {
        if (is_on_bus(each, ble) && each != old) {
            sum += share_of_bus(count_frames(each->length, each->fd, ble), gap, message_span(each));
        }
    }
    sum += share_of_bus(count, gap, in->n * in->period);
    return sum > MILLION ? -TEDS_DOES_NOT_FIT : 0;
}

static int check_start(const asked *in, const teds_origin *origin, uint64_t now)
{
    if (in->start == WAITS) {
        return origin->arrival->kind == TEDS_CAN ? 0 : -TEDS_DOES_NOT_FIT;
    }
    if (in->start != 0 && (in->start <= now || in->start > now + LATEST_START)) {
        return -TEDS_TOO_LATE;
    }
    return 0;
}

static teds_stream *find_stream_room(teds_node *node, teds_stream *old)
{
    if (old != NULL) {
        return old;
    }
    for (teds_stream *each = node->streams; each < node->streams + TEDS_STREAMS; each++) {
        if (!each->used) {
            return each;
        }
    }
    return NULL;
}

/* Octets of the longest message on this link; 0: its station has not enabled data notifications. */
static uint32_t longest_message(const teds_node *node, const teds_origin *origin)
{
#if TEDS_BLE
    if (origin->arrival->kind == TEDS_AT_BLE) {
        const size_t connection = origin->link - (size_t)TEDS_LINK_BLE;
        const teds_ble_line *line = &node->ble.lines[connection];
        uint32_t most = 0;
        if (connection < TEDS_BLE_CONNECTIONS && line->used && line->hears) {
            most = line->mtu - BLE_DATA_HEAD;
        }
        return most < TEDS_MESSAGE ? most : TEDS_MESSAGE;
    }
#else
    (void)node;
    (void)origin;
#endif
    return TEDS_MESSAGE;
}

int teds_subscribe(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    teds_session *session = origin->session;
    const bool fd = origin->arrival->fd && TEDS_CAN_FD, ble = origin->arrival->kind == TEDS_AT_BLE;
    uint64_t now = teds_now(node);
    teds_stream *old, *stream;
    uint8_t key[16];
    uint32_t length, most;
    asked in;
    int refused = read_asked(command, &in);
    if (refused) {
        return refused;
    }
    if (origin->arrival->kind == TEDS_AT_NFC) {
        return -TEDS_DOES_NOT_FIT;
    }
    most = longest_message(node, origin);
    if (most == 0) {
        return -TEDS_WRONG_STATE;
    }
    refused = check_channels(node, command, origin, &in);
    if (!refused) {
        refused = check_period(node, &in);
    }
    if (refused) {
        return refused;
    }
    length = 13u + (uint32_t)in.n * in.octets + (in.kind == PERIODIC ? 0 : 8);
    if (length > most) {
        return -TEDS_TOO_LARGE;
    }
    old = find_stream(node, origin->session, in.stream);
    refused = check_budget(node, &in, count_frames(length, fd, ble), ble, old);
    if (!refused) {
        refused = check_start(&in, origin, now);
    }
    if (refused) {
        return refused;
    }
    stream = find_stream_room(node, old);
    if (session->run == UINT16_MAX || stream == NULL) {
        return -TEDS_NO_ROOM;
    }
    session->run++;
    if (teds_run_key(node, session, "TEDS1 stream", 13, key) != 0) {
        return -TEDS_FAILURE;
    }
    if (old != NULL) {
        end_stream(node, old);
    }
    memset(stream, 0, sizeof *stream);
    stream->used = true;
    stream->session = origin->session;
    stream->number = in.stream;
    stream->kind = in.kind;
    stream->pattern = in.pattern;
    stream->n = in.n;
    stream->count = in.count;
    stream->octets = in.octets;
    stream->gap = in.gap;
    stream->fd = fd;
    stream->ble = ble;
    stream->run = session->run;
    stream->length = (uint16_t)length;
    stream->period = in.period;
    stream->waits = in.start == WAITS;
    stream->start = in.start == 0 ? now + SOON_NS : in.start;
    memcpy(stream->channels, in.places, sizeof in.places);
    memcpy(stream->key, key, sizeof key);
    teds_wipe(key, sizeof key);
    teds_put16(out, stream->run);
    teds_put16(out + 2, stream->length);
    teds_put64(out + 4, stream->start);
    return 12;
}

int teds_stop(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    teds_stream *stream = find_stream(node, origin->session, command->payload[0]);
    if (stream == NULL) {
        return -TEDS_WRONG_STATE;
    }
    teds_put32(out, stream->ended ? UINT32_MAX : stream->counter);
    end_stream(node, stream);
    return 4;
}

/* -- samples ------------------------------------------------------------------------------------------------------- */

static void advance_counter(teds_stream *stream)
{
    stream->ended = stream->counter == UINT32_MAX;
    stream->counter++;
}

static void close_message(teds_stream *stream)
{
    stream->missed += stream->full;
    stream->full = true;
    stream->full_counter = stream->counter;
    stream->full_flags = stream->flags | stream->pattern;
    memcpy(stream->waiting, stream->filling, stream->fill);
    stream->fill = 0;
    stream->flags = 0;
    stream->held = 0;
    advance_counter(stream);
}

/* Sample k of a channel in a test pattern: (k + channel) mod 2^(8 octets). */
static void put_pattern(uint8_t channel, uint8_t octets, uint64_t index, uint8_t *out)
{
    uint64_t value = index + channel;
    for (size_t i = octets; i-- > 0; value >>= 8) {
        out[i] = (uint8_t)value;
    }
}

static void sample_instant(teds_node *node, teds_stream *stream, uint64_t tick)
{
    uint64_t index = (uint64_t)stream->counter * stream->n + stream->held;
    if (stream->held == 0 && stream->kind == FREE) {
        teds_put64(stream->filling, tick);
        stream->fill = 8;
    }
    for (size_t i = 0; i < stream->count; i++) {
        const teds_channel *own = &node->port->channels[stream->channels[i]];
        uint8_t *at = stream->filling + stream->fill;
        if (stream->pattern != 0) {
            put_pattern(own->number, own->octets, index, at);
        } else if (!teds_read_channel(node, stream->channels[i], tick, at)) {
            stream->flags |= 1;
        }
        stream->fill = (uint16_t)(stream->fill + own->octets);
    }
    stream->held++;
    if (stream->held == stream->n) {
        close_message(stream);
    }
}

static uint64_t next_instant(const teds_stream *stream)
{
    if (stream->waits || stream->ended || (stream->kind == EVENT && stream->pattern == 0)) {
        return TEDS_NEVER;
    }
    return stream->start + ((uint64_t)stream->counter * stream->n + stream->held) * stream->period;
}

/* True if the next data message may be started on a bus. */
static bool is_bus_free(const teds_node *node, bool ble, uint64_t now)
{
#if TEDS_BLE
    if (ble) {
        return now >= node->ble.data_free_at;
    }
#else
    (void)ble;
#endif
    return node->can.data_stream == NULL && now >= node->can.data_free_at;
}

static void sample_stream(teds_node *node, teds_stream *stream, uint64_t now)
{
    uint64_t due = next_instant(stream);
    /* two messages may be full at once */
    stream->late = stream->late || (due <= now && now - due >= message_span(stream));
    while ((due = next_instant(stream)) <= now) {
        if (stream->kind == EVENT) {
            teds_put64(stream->filling, due);
            put_pattern(node->port->channels[stream->channels[0]].number, stream->octets, stream->counter,
                        stream->filling + 8);
            stream->fill = (uint16_t)(8 + stream->octets);
            close_message(stream);
            continue;
        }
        if (stream->full && stream->ready && stream->held + 1u == stream->n &&
            (is_bus_free(node, stream->ble, now) || stream->late)) {
            /* the loop is late, not the bus: first send what waits or is half sent; the loop calls again at once */
            return;
        }
        if (stream->held == 0 && now - due >= 2 * message_span(stream) + ASLEEP_NS && stream->counter < UINT32_MAX) {
            /* The board slept for longer than a station waits: the missed messages count as lost. */
            uint64_t lost = (now - due) / message_span(stream) - 1;
            lost = lost < UINT32_MAX - stream->counter ? lost : UINT32_MAX - stream->counter;
            stream->counter += (uint32_t)lost;
            stream->missed += lost;
            continue;
        }
        sample_instant(node, stream, due);
    }
    stream->late = false; /* it has caught up */
}

/* An event sooner than the period after the last one sent is dropped, with its counter. */
static void add_event(teds_stream *stream, uint64_t tick, const uint8_t *octets, bool valid)
{
    if (stream->had_event && tick - stream->last_event < stream->period) {
        advance_counter(stream);
        return;
    }
    stream->had_event = true;
    stream->last_event = tick;
    stream->flags = valid ? 0 : 1;
    teds_put64(stream->filling, tick);
    memcpy(stream->filling + 8, octets, stream->octets);
    stream->fill = (uint16_t)(8 + stream->octets);
    close_message(stream);
}

static uint8_t next_in_ring(uint8_t place)
{
    return (uint8_t)((place + 1) % (TEDS_EVENTS + 1));
}

void teds_sensor_event(teds_node *node, uint8_t channel, uint64_t tick, const uint8_t *octets, bool valid)
{
    teds_events *events = node->events;
    const teds_channel *own = node->port->channels;
    size_t left = node->port->channel_count;
    uint8_t at;
    for (; left > 0 && own->number != channel; left--, own++) {
        events += own->kind == TEDS_EVENT_SENSOR ? 1 : 0;
    }
    if (left == 0 || own->kind != TEDS_EVENT_SENSOR) {
        return;
    }
    at = events->in;
    if (next_in_ring(at) == events->out) {
        events->lost++;
        return;
    }
    events->ring[at].tick = tick;
    events->ring[at].valid = valid;
    for (size_t i = 0; i < own->octets; i++) {
        events->ring[at].octets[i] = octets[i];
    }
    events->in = next_in_ring(at);
}

/* Take the events that the interrupts of one sensor have queued, for one of its streams. */
static void take_events(const teds_events *events, teds_stream *stream, uint8_t in, uint16_t lost, uint64_t now)
{
    uint8_t octets[TEDS_EVENT_OCTETS];
    for (uint8_t at = events->out; at != in && !stream->ended; at = next_in_ring(at)) {
        for (size_t i = 0; i < stream->octets; i++) {
            octets[i] = events->ring[at].octets[i];
        }
        if (events->ring[at].tick >= stream->start) {
            add_event(stream, events->ring[at].tick, octets, events->ring[at].valid);
        }
    }
    for (; lost > 0 && now >= stream->start && !stream->ended; lost--) {
        advance_counter(stream);
    }
}

static void take_all_events(teds_node *node, uint64_t now)
{
    teds_events *events = node->events;
    for (size_t place = 0; place < node->port->channel_count; place++) {
        uint8_t in;
        uint16_t lost;
        if (node->port->channels[place].kind != TEDS_EVENT_SENSOR) {
            continue;
        }
        in = events->in;
        lost = events->lost;
        for (teds_stream *each = node->streams; each < node->streams + TEDS_STREAMS; each++) {
            if (each->used && each->kind == EVENT && each->pattern == 0 && !each->waits && each->channels[0] == place) {
                take_events(events, each, in, (uint16_t)(lost - events->reported), now);
            }
        }
        events->out = in;
        events->reported = lost;
        events++;
    }
}

void teds_streams_sample(teds_node *node, uint64_t now)
{
    take_all_events(node, now);
    for (teds_stream *each = node->streams; each < node->streams + TEDS_STREAMS; each++) {
        if (each->used) {
            sample_stream(node, each, now);
            if (each->ended && !each->full && node->can.data_stream != each) {
                end_stream(node, each); /* the message with the last counter was sent */
            }
        }
    }
}

uint64_t teds_streams_due(teds_node *node)
{
    uint64_t due = teds_data_due(node);
    for (teds_stream *each = node->streams; each < node->streams + TEDS_STREAMS; each++) {
        if (each->used) {
            uint64_t at = next_instant(each);
            due = at < due ? at : due;
        }
    }
    return due;
}

/* -- data messages ------------------------------------------------------------------------------------------------- */

/* Of waiting messages, the one with the smallest n * period is next; NULL: none. */
static teds_stream *choose_stream(teds_node *node, bool ble)
{
    teds_stream *chosen = NULL;
    for (teds_stream *each = node->streams; each < node->streams + TEDS_STREAMS; each++) {
        if (is_on_bus(each, ble) && each->ready && each->full && (chosen == NULL || message_span(each) < message_span(chosen))) {
            chosen = each;
        }
    }
    return chosen;
}

uint64_t teds_data_due(teds_node *node)
{
    uint64_t due = node->can.data_stream != NULL || choose_stream(node, false) != NULL ? node->can.data_free_at : TEDS_NEVER;
#if TEDS_BLE
    if (choose_stream(node, true) != NULL && node->ble.data_free_at < due) {
        due = node->ble.data_free_at;
    }
#endif
    return due;
}

/* Seal the waiting message. */
static bool seal_message(const teds_node *node, teds_stream *stream, uint8_t *out)
{
    uint8_t nonce[13] = {0};
    stream->full = false;
    teds_put32(out, stream->full_counter);
    teds_put32(nonce + 9, stream->full_counter);
    out[4] = stream->full_flags;
    memcpy(out + 5, stream->waiting, stream->length - 13u);
    if (node->port->ccm_seal(node->port->user, stream->key, nonce, out + 4, stream->length - 12u, out + 4, 8) != 0) {
        stream->missed++;
        return false;
    }
    return true;
}

static bool begin_message(teds_node *node)
{
    teds_can *can = &node->can;
    teds_stream *chosen = choose_stream(node, false);
    if (chosen == NULL || !seal_message(node, chosen, can->data)) {
        return false;
    }
    can->data_stream = chosen;
    can->data_at = 0;
    can->data_length = chosen->length;
    can->data_segment = 0;
    return true;
}

static uint64_t gap_of_bus(const teds_node *node, bool ble)
{
    uint64_t gap = 1;
    for (const teds_stream *each = node->streams; each < node->streams + TEDS_STREAMS; each++) {
        gap = is_on_bus(each, ble) && each->gap > gap ? each->gap : gap;
    }
    return gap * MICRO;
}

#if TEDS_BLE
size_t teds_data_notify(teds_node *node, teds_link *link, uint8_t *out, uint64_t now)
{
    teds_stream *stream = choose_stream(node, true);
    if (stream == NULL || !is_bus_free(node, true, now)) {
        return 0;
    }
    if (!seal_message(node, stream, out + 1)) {
        return 0;
    }
    out[0] = stream->number;
    *link = stream->session->link;
    node->ble.data_free_at = now + gap_of_bus(node, true);
    return 1u + stream->length;
}
#endif

bool teds_data_next(teds_node *node, teds_can_frame *frame, uint64_t now)
{
    teds_can *can = &node->can;
    const teds_stream *stream;
    size_t octets, room;
    uint32_t s;
    if (now < can->data_free_at || (can->data_stream == NULL && !begin_message(node))) {
        return false;
    }
    stream = can->data_stream;
    room = stream->fd ? 64 : 8;
    octets = (size_t)(can->data_length - can->data_at) < room ? (size_t)(can->data_length - can->data_at) : room;
    s = (stream->session->link & 7u) << 5 | (uint32_t)stream->number << 3 | can->data_segment;
    frame->identifier = DATA | s << 8 | can->address;
    frame->fd = stream->fd;
    memcpy(frame->data, can->data + can->data_at, octets);
    frame->length = (uint8_t)octets;
    if (stream->fd && octets > 8) {
        teds_can_pad(frame, octets);
    }
    can->data_free_at = now + gap_of_bus(node, false);
    can->data_at = (uint16_t)(can->data_at + octets);
    can->data_segment = (uint8_t)(can->data_segment % 7 + 1);
    if (can->data_at == can->data_length) {
        can->data_stream = NULL;
    }
    return true;
}

#else
typedef int teds_stream_is_left_out;
#endif
