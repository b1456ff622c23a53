/* Packets of plushsense verify --device; plush_device.h describes them. */
#include "plush_device.h"

#include <string.h>

#define HEAD_BYTES 3u /* of what the checksum covers: the letter and the length */

static uint8_t in[HEAD_BYTES + PLUSH_DEVICE_MOST_BYTES], out[HEAD_BYTES + PLUSH_DEVICE_MOST_BYTES];
static uint32_t filled, taken, written; /* bytes of the packet that came, of those that were read, of rows to send */
static int broken;                      /* the link: nothing more is read or sent */

/* Bytes that the harness keeps until a case ends, and those that it reads at once. */
static uint32_t room[PLUSH_DEVICE_ROOM_BYTES / 4u + 1u];
static uint32_t kept;
static uint8_t passing[4u * (1u + PLUSH_MODEL_CHANNELS)];

/* What is measured in a case: pushes while tracking, of those with an answer the longest. */
static uint32_t steps, most, pushes;
static uint64_t total;

static uint32_t crc(const uint8_t *bytes, uint32_t n)
{
    uint32_t sum = UINT32_MAX, bit;

    for (; n > 0; n--) {
        sum ^= *bytes++;
        for (bit = 0; bit < 8; bit++)
            sum = (sum >> 1) ^ ((sum & 1u) != 0 ? UINT32_C(0xedb88320) : 0u);
    }
    return ~sum;
}

static uint8_t *put(uint8_t *to, uint32_t value)
{
    uint32_t i;

    for (i = 0; i < 4; i++)
        *to++ = (uint8_t)(value >> (8u * i));
    return to;
}

/* Sends what `out` holds behind the head. */
static void send(char letter, uint32_t n)
{
    uint8_t sum[4];
    uint32_t i;

    out[0] = (uint8_t)letter;
    out[1] = (uint8_t)n;
    out[2] = (uint8_t)(n >> 8);
    put(sum, crc(out, HEAD_BYTES + n));
    plush_hook_write('P');
    plush_hook_write('V');
    for (i = 0; i < HEAD_BYTES + n; i++)
        plush_hook_write(out[i]);
    for (i = 0; i < 4; i++)
        plush_hook_write(sum[i]);
}

static void send_words(char letter, const char *words)
{
    uint32_t n = (uint32_t)strlen(words);

    memcpy(out + HEAD_BYTES, words, (size_t)n);
    send(letter, n);
}

static void send_rows(void)
{
    if (written > 0)
        send('r', written);
    written = 0;
}

static void break_off(const char *words)
{
    send_rows();
    send_words('e', words);
    broken = 1;
}

/* Waits for a packet. Returns its letter; 0 when it is damaged. What comes before it is passed over. */
static char receive(void)
{
    uint32_t n, i, sum = 0;
    uint8_t byte = plush_hook_read();

    do {
        while (byte != 'P')
            byte = plush_hook_read();
        byte = plush_hook_read();
    } while (byte != 'V');
    for (i = 0; i < HEAD_BYTES; i++)
        in[i] = plush_hook_read();
    n = (uint32_t)in[1] | (uint32_t)in[2] << 8;
    if (n > PLUSH_DEVICE_MOST_BYTES)
        return 0;
    for (i = 0; i < n; i++)
        in[HEAD_BYTES + i] = plush_hook_read();
    for (i = 0; i < 4; i++)
        sum |= (uint32_t)plush_hook_read() << (8u * i);
    if (sum != crc(in, HEAD_BYTES + n))
        return 0;
    filled = n;
    taken = 0;
    return (char)in[0];
}

static void greet(void)
{
    static const uint32_t numbers[6] = {
        PLUSH_DEVICE_VERSION, PLUSH_MODEL_ID, PLUSH_MODEL_CHANNELS, PLUSH_MODEL_CLASSES, PLUSH_DEVICE_MEMORY_BYTES,
        PLUSH_DEVICE_ROOM_BYTES / 4u * 4u,
    };
    uint8_t *to = out + HEAD_BYTES;
    uint32_t i;

    for (i = 0; i < 6; i++)
        to = put(to, numbers[i]);
    i = (uint32_t)strlen(plush_hook_counter);
    memcpy(to, plush_hook_counter, (size_t)i);
    send('h', 4u * 6u + i);
}

/* Asks for the next bytes. Returns whether there are any. */
static int more(void)
{
    char letter;

    if (broken)
        return 0;
    send_rows();
    send('n', 0);
    letter = receive();
    if (letter == 'D')
        return filled > 0;
    if (letter == 'H') { /* the computer began again */
        broken = 1;
        greet();
    } else {
        break_off("a packet of the computer came damaged");
    }
    return 0;
}

static void begin_case(void)
{
    kept = pushes = steps = most = 0;
    total = 0;
}

static void end_case(void)
{
    uint8_t *to = out + HEAD_BYTES;

    if (broken)
        return;
    send_rows();
    if (pushes > 0) {
        to = put(put(put(to, pushes), steps), most);
        put(put(to, (uint32_t)total), (uint32_t)(total >> 32));
        send('m', 20);
    }
    begin_case();
}

int plush_device_case(void)
{
    end_case();
    return more();
}

const uint8_t *plush_device_bytes(uint32_t n, int keep)
{
    uint8_t *to = keep ? (uint8_t *)room + kept : passing;
    uint32_t left = keep ? (uint32_t)sizeof room - kept : (uint32_t)sizeof passing, got;
    const uint8_t *bytes = to;

    if (n > left) {
        break_off("it was sent more than it has room for");
        return NULL;
    }
    if (keep)
        kept += n;
    while (n > 0) {
        if (broken || (taken == filled && !more()))
            return NULL;
        got = n < filled - taken ? n : filled - taken;
        memcpy(to, in + HEAD_BYTES + taken, (size_t)got);
        to += got;
        taken += got;
        n -= got;
    }
    return bytes;
}

void plush_device_row(const uint8_t *bytes, uint32_t n)
{
    uint32_t got;

    for (; n > 0 && !broken; n -= got, bytes += got) {
        got = PLUSH_DEVICE_MOST_BYTES - written;
        if (got > n)
            got = n;
        memcpy(out + HEAD_BYTES + written, bytes, (size_t)got);
        written += got;
        if (written == PLUSH_DEVICE_MOST_BYTES)
            send_rows();
    }
}

void plush_device_words(const char *words)
{
    if (broken)
        return;
    send_rows();
    send_words('w', words);
}

uint32_t plush_device_cycles(void)
{
    return plush_hook_cycles();
}

void plush_device_measure(uint32_t cycles, uint32_t answers, int tracking)
{
    if (!tracking)
        return;
    pushes++;
    steps += answers;
    total += cycles;
    if (cycles > most)
        most = cycles;
}

void plush_device_run(void)
{
    plush_hook_begin();
    plush_hook_begin_counter();
    for (;;) {
        char letter = receive();

        if (letter == 'H')
            greet();
        if (letter != 'S')
            continue;
        broken = 0;
        filled = taken = written = 0;
        begin_case();
        plush_device_cases();
        if (!broken)
            send('d', 0);
    }
}
