/* SPDX-License-Identifier: Apache-2.0 */
/* The published vectors (`make vectors-c`), in C alone: canonical forms, every transcript, every exchange on CAN. */
#include "check.h"
#include "security_teds.h"
#include "inside.h"
#include "memory.h"
#include "teds_vectors.h"

#include <stdlib.h>
#include <string.h>

static uint8_t identity[32], one_time[32], counter[8], nonce[16];

static int draw(char kind, uint8_t *out, size_t length)
{
    if (kind == 'i' || kind == 'o') {
        memcpy(out, kind == 'i' ? identity : one_time, 32);
    } else if (length == 8 || length == 16) {
        memcpy(out, length == 8 ? counter : nonce, length);
    } else {
        memset(out, 0, length); /* a wait */
    }
    return 0;
}

static void take(uint8_t *out, size_t room, teds_octets octets)
{
    if (octets.octets != NULL && octets.length <= room) {
        memcpy(out + room - octets.length, octets.octets, octets.length);
    }
}

static const teds_node nobody; /* its key and signature are in no entry, which only the commit asks */

static void canonical(void)
{
    const struct teds_canonical *file = &teds_vectors_canonical;
    teds_signed found;
    for (size_t i = 0; i < file->entries_count; i++) {
        const struct teds_canonical_entries *entry = &file->entries[i];
        bool good = teds_own_check(128, entry->teds.octets, entry->teds.length) &&
                    teds_security_parse(&nobody, entry->teds.octets + 4, entry->teds.length - 6, &found);
        CHECK(good == (entry->reason != 4), "canonical %s", entry->name);
    }
}

static uint8_t link_of(const char *name, uint8_t *kind)
{
    *kind = strncmp(name, "can", 3) == 0 ? TEDS_CAN : TEDS_AT_NFC;
    return *kind == TEDS_CAN ? (uint8_t)strtoul(name + 4, NULL, 16) : 1;
}

static void put(memory_board *board, const struct teds_transcripts_entries_start *start)
{
    static uint8_t image[TEDS_STAGING];
    static const uint8_t none[65] = {0};
    size_t length = 0;
    uint8_t flags = strcmp(start->state, "factory") == 0 ? 0 : strcmp(start->state, "keyed") == 0 ? 1 : 3;
    for (size_t i = 0; i < start->blocks_count; i++) {
        const struct teds_transcripts_entries_start_blocks *block = &start->blocks[i];
        if (block->read_only) {
            memory_fixed(board, (uint8_t)block->channel, (uint8_t)block->access_code, block->teds.octets,
                         (uint16_t)block->teds.length);
            continue;
        }
        image[length] = (uint8_t)block->channel;
        image[length + 1] = (uint8_t)block->access_code;
        image[length + 2] = (uint8_t)(block->teds.length >> 8);
        image[length + 3] = (uint8_t)block->teds.length;
        memcpy(image + length + 4, block->teds.octets, block->teds.length);
        length += 4 + block->teds.length;
    }
    CHECK(memory_put(board, flags, (uint8_t)start->can_address, (uint32_t)start->epoch, (uint32_t)start->sequence,
                     start->K.octets != NULL ? start->K.octets : none,
                     start->station.octets != NULL ? start->station.octets : none,
                     start->ca.octets != NULL ? start->ca.octets : none, image, length) == 0,
          "the start");
}

static void event(memory_board *board, const struct teds_transcripts_entries_steps *step)
{
    uint8_t kind;
    if (strcmp(step->event, "link_lost") == 0) {
        memory_lost(board, link_of(step->link, &kind));
    } else if (strcmp(step->event, "restart") == 0) {
        CHECK(memory_start(board) == 0, "restart");
    } else if (strcmp(step->event, "reset_by_hand") == 0) {
        CHECK(memory_by_hand(board) == 0, "by hand");
    } else {
        memory_fails(board, strcmp(step->event, "flash_fails") == 0);
    }
}

static void transcript(const struct teds_transcripts *file, const struct teds_transcripts_entries *entry)
{
    static uint8_t reply[TEDS_MAX_MESSAGE];
    memory_board *board;
    if (entry->start->max_message != TEDS_MAX_MESSAGE || entry->start->max_teds != TEDS_STAGING - 4) {
        return; /* of a node of another size: played by pytest */
    }
    take(counter, 8, entry->start->c);
    for (size_t i = 0; i < file->keys_count; i++) {
        if (strcmp(file->keys[i].name, "node") == 0) {
            take(identity, 32, file->keys[i].d);
        }
    }
    board = memory_new(file->uuid.octets, 8, 0xFF, draw);
    CHECK(board != NULL && memory_start(board) == 0, "%s", entry->name);
    put(board, entry->start);
    for (size_t i = 0; i < entry->steps_count; i++) {
        const struct teds_transcripts_entries_steps *step = &entry->steps[i];
        uint8_t kind, number;
        size_t length;
        take(counter, 8, step->c);
        take(nonce, 16, step->nonceN);
        take(one_time, 32, step->En);
        memory_at(board, (uint64_t)(step->at * 1e9));
        if (step->event != NULL) {
            event(board, step);
            continue;
        }
        number = link_of(step->link, &kind);
        length = memory_handle(board, number, kind, step->tapped, step->command.octets, step->command.length, reply);
        memory_reply_left(board, number);
        CHECK(length == step->reply.length && memcmp(reply, step->reply.octets, length) == 0, "%s, step %u: %s",
              entry->name, (unsigned)i, step->note);
    }
    CHECK(!memory_misused(board), "%s: flash was misused", entry->name);
    memory_free(board);
}

/* An exchange frame by frame: what the station sends goes in, what the node sends must come out, octet for octet. */
static void exchange(const struct teds_can_frames *file, const struct teds_can_frames_entries *entry)
{
    static const uint8_t none[65] = {0};
    memory_board *board;
    uint64_t now = 1000000000u;
    bool drawn = entry->reply.length != 168;
    if (entry->conflict || entry->reply.length < 3) {
        return;
    }
    for (size_t i = 0; i < file->keys_count; i++) {
        if (strcmp(file->keys[i].name, "node") == 0) {
            take(identity, 32, file->keys[i].d);
        }
        if (entry->reply.length == 168 && memcmp(file->keys[i].P.octets, entry->reply.octets + 23, 65) == 0) {
            take(one_time, 32, file->keys[i].d);
            memcpy(nonce, entry->reply.octets + 3, 16);
            drawn = true;
        }
    }
    if (!drawn) {
        return; /* the scalar of its one-time key is not published */
    }
    board = memory_new(file->uuid.octets, 8, 0xFF, draw);
    CHECK(board != NULL && memory_start(board) == 0, "%s", entry->name);
    CHECK(memory_put(board, 0, (uint8_t)entry->node_address, 0, 0, none, none, none, none, 0) == 0, "%s",
          entry->name);
    for (size_t i = 0; i < entry->steps_count; i++) {
        const struct teds_can_frames_entries_steps *step = &entry->steps[i];
        uint32_t identifier = 0;
        uint8_t data[64];
        bool fd = false;
        int length;
        now += 1000000u;
        memory_at(board, now);
        if (strcmp(step->by, "station") == 0) {
            memory_can_rx(board, teds_get32(step->id.octets), step->data.octets, (uint8_t)step->data.length, step->fd);
            continue;
        }
        length = memory_can_tx(board, &identifier, data, &fd);
        CHECK(length == (int)step->data.length && identifier == teds_get32(step->id.octets) && fd == step->fd &&
                  memcmp(data, step->data.octets, step->data.length) == 0,
              "%s, frame %u: %s", entry->name, (unsigned)i, step->note);
    }
    memory_free(board);
}

int main(void)
{
    const struct teds_transcripts *files[] = {&teds_vectors_rotation, &teds_vectors_sessions, &teds_vectors_refusals,
                                              &teds_vectors_commit, &teds_vectors_reset};
    canonical();
    for (size_t f = 0; f < sizeof files / sizeof files[0]; f++) {
        for (size_t i = 0; i < files[f]->entries_count; i++) {
            transcript(files[f], &files[f]->entries[i]);
        }
    }
    for (size_t i = 0; i < teds_vectors_can_frames.entries_count; i++) {
        exchange(&teds_vectors_can_frames, &teds_vectors_can_frames.entries[i]);
    }
    return ENDED("vectors");
}
