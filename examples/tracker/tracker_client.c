/* Reference tracker client: what a camera system has to send to the bridge. C99 with POSIX sockets, no library.
 *
 * Copy struct tracker_frame and tracker_datagram(), and send one datagram per camera frame to the bridge's UDP port, also
 * while no ball is seen: silence with a ball in play is a fault. Run as a program, it sends a synthetic ball and prints
 * what it sends:
 *
 *     cc -std=c99 -Wall -Wextra -Werror -O2 -o tracker_client examples/tracker/tracker_client.c
 *     ./tracker_client 127.0.0.1 6520 10
 *
 * A robot that is armed plays the synthetic ball like any other: disarm it first. tracker_client.py is the same in Python.
 * docs/how-to/connect-a-tracker.md describes the datagram, the clock and what the bridge refuses.
 */
#define _POSIX_C_SOURCE 200112L
#include <arpa/inet.h>
#include <netinet/in.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#define TRACKER_BYTES 48
#define RATE 125    /* [Hz] frames per second */
#define REACH 10.0  /* [m] the bridge refuses coordinates beyond this */

struct tracker_frame {
    uint32_t sequence;    /* counts every frame by 1, with or without a ball; wraps around. Gaps count as lost frames;
                             a number that was sent before, or an earlier one, is refused */
    uint16_t ball;        /* number of the ball in play, 1 more with each new ball; wraps around. A ball keeps its number
                             while it is out of sight, and frames without a ball repeat the last number */
    int64_t captured_ns;  /* [ns] when the cameras exposed the frame, not when it was computed or sent. A monotonic clock:
                             it never jumps, later frames have later times. On the bridge's own computer CLOCK_MONOTONIC;
                             on another one the bridge adds tracker.clock_offset */
    int seen;             /* 0 while no ball is seen; the position does not matter then, zeros are sent */
    double position[3];   /* x, y, z [m] of the ball's centre in the table frame: origin at the centre of the table's
                             surface, x across, y along the table towards the human, z up */
};

/* Write the low `bytes` bytes of a value, least significant first, whatever this computer's byte order is. */
static uint8_t *put(uint8_t *out, uint64_t value, int bytes) {
    for (int i = 0; i < bytes; i++) *out++ = (uint8_t)(value >> (8 * i));
    return out;
}

/* CRC-32 as in zlib and Ethernet: reflected polynomial EDB88320, start and end inverted. */
static uint32_t crc32(const uint8_t *data, int bytes) {
    uint32_t crc = 0xFFFFFFFFu;
    while (bytes--) {
        crc ^= *data++;
        for (int bit = 0; bit < 8; bit++) crc = (crc >> 1) ^ (crc & 1 ? 0xEDB88320u : 0);
    }
    return ~crc;
}

/* The datagram of a frame; -1, with nothing written, for a position that the bridge would refuse, else 0. */
int tracker_datagram(const struct tracker_frame *frame, uint8_t out[TRACKER_BYTES]) {
    static const double nowhere[3] = {0.0, 0.0, 0.0};
    const double *position = frame->seen ? frame->position : nowhere;
    for (int i = 0; i < 3; i++)
        if (!(position[i] >= -REACH && position[i] <= REACH)) return -1; /* NaN fails every comparison */
    memcpy(out, "TTBL", 4);
    uint8_t *p = put(out + 4, 1, 1);             /* version */
    p = put(p, frame->seen ? 1 : 0, 1);          /* flags: bit 0, a ball is seen */
    p = put(p, frame->ball, 2);
    p = put(p, frame->sequence, 4);
    p = put(p, (uint64_t)frame->captured_ns, 8); /* two's complement */
    for (int i = 0; i < 3; i++) {
        uint64_t bits; /* IEEE 754 binary64 */
        memcpy(&bits, &position[i], sizeof bits);
        p = put(p, bits, 8);
    }
    put(p, crc32(out, TRACKER_BYTES - 4), 4);
    return 0;
}

static int64_t now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

/* A synthetic ball: each second 0.3 s of empty table, then a ball towards the robot, without drag. */
static void synthetic(struct tracker_frame *frame) {
    const double bounce = 0.437, t = (double)(frame->sequence % RATE) / RATE - 0.3; /* [s] */
    frame->seen = t >= 0.0;
    frame->ball = (uint16_t)(frame->sequence / RATE + (frame->seen ? 1 : 0));
    frame->position[0] = 0.1 * t;
    frame->position[1] = 1.5 - 5.0 * t;
    frame->position[2] = t > bounce ? 0.02 + 2.4 * (t - bounce) - 4.905 * (t - bounce) * (t - bounce)
                                    : 0.3 + 1.5 * t - 4.905 * t * t;
}

int main(int argc, char **argv) {
    struct sockaddr_in bridge = {0};
    if (argc != 4 || inet_pton(AF_INET, argv[1], &bridge.sin_addr) != 1) {
        fprintf(stderr, "usage: %s IPV4_ADDRESS PORT SECONDS\n", argv[0]);
        return 2;
    }
    bridge.sin_family = AF_INET;
    bridge.sin_port = htons((uint16_t)atoi(argv[2]));
    /* One socket, kept for the whole session: the bridge trusts the address and port of the first valid frame. */
    int sender = socket(AF_INET, SOCK_DGRAM, 0);
    if (sender < 0) return perror("socket"), 1;
    const int64_t began = now_ns();
    for (uint32_t n = 0; n < (uint32_t)(atof(argv[3]) * RATE); n++) {
        int64_t wait = began + (int64_t)n * 1000000000 / RATE - now_ns(); /* absolute times: delays do not add up */
        if (wait > 0) nanosleep(&(struct timespec){wait / 1000000000, wait % 1000000000}, NULL);
        struct tracker_frame frame = {.sequence = n, .captured_ns = now_ns()};
        uint8_t bytes[TRACKER_BYTES];
        synthetic(&frame);
        if (tracker_datagram(&frame, bytes) != 0) continue;
        if (sendto(sender, bytes, sizeof bytes, 0, (struct sockaddr *)&bridge, sizeof bridge) < 0) perror("sendto");
        printf("%u %u %lld", (unsigned)n, (unsigned)frame.ball, (long long)frame.captured_ns);
        if (frame.seen) printf(" %.17g %.17g %.17g\n", frame.position[0], frame.position[1], frame.position[2]);
        else printf(" none\n");
        fflush(stdout);
    }
    return close(sender);
}
