/* Frames to text and back with the generated C headers alone, for any message of the dialect:
 *     decode HEX                                    -> NAME system component sequence field=v,v ...
 *     encode NAME system component sequence field=v,v ... [@key=HEX @link=N @time=N]   -> HEX
 * one line each from stdin; `decode HEX @key=HEX` checks the signature. Characters are in
 * hexadecimal, without the zeros at their end. */
#include <inttypes.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MAVLINK_USE_MESSAGE_INFO
#include "quad_mavlink.h"

typedef struct {
    mavlink_status_t status;
    mavlink_signing_t signing;
    mavlink_signing_streams_t streams;
} state;

static size_t from_hex(const char *text, uint8_t *bytes, size_t room)
{
    size_t count = 0;
    unsigned value;
    while (count < room && sscanf(&text[2 * count], "%2x", &value) == 1) {
        bytes[count++] = (uint8_t)value;
    }
    return count;
}

static void set_key(state *s, const char *hex)
{
    from_hex(hex, s->signing.secret_key, 32);
    s->signing.flags = MAVLINK_SIGNING_FLAG_SIGN_OUTGOING;
    s->status.signing = &s->signing;
    s->status.signing_streams = &s->streams;
}

static size_t size_of(mavlink_message_type_t type)
{
    switch (type) {
    case MAVLINK_TYPE_UINT16_T:
    case MAVLINK_TYPE_INT16_T:
        return 2;
    case MAVLINK_TYPE_UINT32_T:
    case MAVLINK_TYPE_INT32_T:
    case MAVLINK_TYPE_FLOAT:
        return 4;
    case MAVLINK_TYPE_UINT64_T:
    case MAVLINK_TYPE_INT64_T:
    case MAVLINK_TYPE_DOUBLE:
        return 8;
    default:
        return 1;
    }
}

static void show(const uint8_t *at, mavlink_message_type_t type)
{
    uint64_t bits = 0;
    float real;
    const size_t size = size_of(type);
    memcpy(&bits, at, size);
    if (type == MAVLINK_TYPE_FLOAT) {
        memcpy(&real, at, 4);
        printf("%.9g", real);
    } else if (type == MAVLINK_TYPE_INT8_T) {
        printf("%d", (int8_t)bits);
    } else if (type == MAVLINK_TYPE_INT16_T) {
        printf("%d", (int16_t)bits);
    } else if (type == MAVLINK_TYPE_INT32_T) {
        printf("%" PRId32, (int32_t)bits);
    } else if (type == MAVLINK_TYPE_INT64_T) {
        printf("%" PRId64, (int64_t)bits);
    } else {
        printf("%" PRIu64, bits);
    }
}

static void read_value(const char *text, uint8_t *at, mavlink_message_type_t type)
{
    if (type == MAVLINK_TYPE_FLOAT) {
        const float real = strtof(text, NULL);
        memcpy(at, &real, 4);
    } else {
        const uint64_t bits =
            text[0] == '-' ? (uint64_t)strtoll(text, NULL, 10) : strtoull(text, NULL, 10);
        memcpy(at, &bits, size_of(type));
    }
}

static void show_field(const uint8_t *payload, const mavlink_field_info_t *f)
{
    const size_t count = f->array_length > 0 ? f->array_length : 1;
    const uint8_t *at = &payload[f->wire_offset];
    printf(" %s=", f->name);
    if (f->type == MAVLINK_TYPE_CHAR) {
        size_t length = count;
        while (length > 0 && at[length - 1] == 0) {
            length--;
        }
        for (size_t i = 0; i < length; i++) {
            printf("%02x", at[i]);
        }
        return;
    }
    for (size_t i = 0; i < count; i++) {
        printf(i > 0 ? "," : "");
        show(&at[i * size_of(f->type)], f->type);
    }
}

static void decode(const char *hex, state *s)
{
    uint8_t bytes[MAVLINK_MAX_PACKET_LEN];
    mavlink_message_t m;
    const size_t count = from_hex(hex, bytes, sizeof bytes);
    uint8_t got = MAVLINK_FRAMING_INCOMPLETE;
    memset(&m, 0, sizeof m);
    for (size_t i = 0; i < count; i++) {
        got = mavlink_frame_char_buffer(&m, &s->status, bytes[i], NULL, NULL);
    }
    const mavlink_message_info_t *info = mavlink_get_message_info_by_id(m.msgid);
    if (got != MAVLINK_FRAMING_OK || info == NULL) {
        printf("refused %u\n", got);
        return;
    }
    printf("%s %u %u %u", info->name, m.sysid, m.compid, m.seq);
    for (unsigned i = 0; i < info->num_fields; i++) {
        show_field((const uint8_t *)_MAV_PAYLOAD(&m), &info->fields[i]);
    }
    printf("\n");
}

static void read_field(uint8_t *payload, const mavlink_field_info_t *f, char *values)
{
    uint8_t *at = &payload[f->wire_offset];
    if (f->type == MAVLINK_TYPE_CHAR) {
        from_hex(values, at, f->array_length);
        return;
    }
    for (char *text = values; text != NULL; at += size_of(f->type)) {
        char *comma = strchr(text, ',');
        read_value(text, at, f->type);
        text = comma == NULL ? NULL : comma + 1;
    }
}

static void encode(char *name, state *s)
{
    const mavlink_message_info_t *info = mavlink_get_message_info_by_name(name);
    mavlink_message_t m;
    uint8_t ids[3], bytes[MAVLINK_MAX_PACKET_LEN];
    if (info == NULL) {
        printf("unknown %s\n", name);
        return;
    }
    const mavlink_msg_entry_t *entry = mavlink_get_msg_entry(info->msgid);
    memset(&m, 0, sizeof m);
    for (int i = 0; i < 3; i++) {
        ids[i] = (uint8_t)atoi(strtok(NULL, " "));
    }
    for (char *token = strtok(NULL, " "); token != NULL; token = strtok(NULL, " ")) {
        char *values = strchr(token, '=');
        *values++ = '\0';
        if (strcmp(token, "@key") == 0) {
            set_key(s, values);
        } else if (strcmp(token, "@link") == 0) {
            s->signing.link_id = (uint8_t)atoi(values);
        } else if (strcmp(token, "@time") == 0) {
            s->signing.timestamp = strtoull(values, NULL, 10);
        }
        for (unsigned i = 0; i < info->num_fields; i++) {
            if (strcmp(info->fields[i].name, token) == 0) {
                read_field((uint8_t *)_MAV_PAYLOAD_NON_CONST(&m), &info->fields[i], values);
            }
        }
    }
    m.msgid = info->msgid;
    s->status.current_tx_seq = ids[2];
    mavlink_finalize_message_buffer(&m, ids[0], ids[1], &s->status, entry->min_msg_len,
                                    entry->max_msg_len, entry->crc_extra);
    const uint16_t count = mavlink_msg_to_send_buffer(bytes, &m);
    for (uint16_t i = 0; i < count; i++) {
        printf("%02x", bytes[i]);
    }
    printf("\n");
}

int main(void)
{
    static char line[8192];
    while (fgets(line, sizeof line, stdin) != NULL) {
        state s;
        memset(&s, 0, sizeof s);
        line[strcspn(line, "\n")] = '\0';
        const char *verb = strtok(line, " ");
        char *first = strtok(NULL, " ");
        if (verb == NULL || first == NULL) {
            continue;
        }
        if (strcmp(verb, "encode") == 0) {
            encode(first, &s);
            continue;
        }
        const char *key = strtok(NULL, " ");
        if (key != NULL) {
            set_key(&s, key + strlen("@key="));
        }
        decode(first, &s);
    }
    return 0;
}
