/* The trigger box on this computer, to try and to test the core without a board.
 *
 *     host [clock]      serves a pseudo-terminal and ends with stdin
 *     host - [clock]    requests from stdin, replies to stdout, ends with stdin
 *
 * `clock` is where the microseconds begin, for trying their wrap. With a terminal, its path is the
 * first line on stdout; then comes a line for each change of the outputs: microseconds since the
 * start, then L, P and C for those that are up, or "-". On stdin a letter sets an input: I i
 * interlock open, closed; E e emergency stop pressed, released; P p the projectors' trigger-out
 * follows their gate (as it does at first), stays down.
 */
#define _XOPEN_SOURCE 700

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "protocol.h"

static tb_box box;
static uint32_t inputs, outputs;
static bool follows = true; /* trigger-out follows the projectors' gate */
static bool telling;

static uint64_t microseconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000U + (uint64_t)now.tv_nsec / 1000U;
}

static void tell(uint64_t at)
{
    printf("%llu %s%s%s%s\n", (unsigned long long)at, outputs & TB_LIGHT_GATE ? "L" : "",
           outputs & TB_PROJECTOR_GATE ? "P" : "", outputs & TB_CAMERAS ? "C" : "",
           outputs == 0U ? "-" : "");
    fflush(stdout);
}

static void steer(char letter)
{
    switch (letter) {
    case 'I': inputs |= TB_INTERLOCK_OPEN; break;
    case 'i': inputs &= ~TB_INTERLOCK_OPEN; break;
    case 'E': inputs |= TB_ESTOP_PRESSED; break;
    case 'e': inputs &= ~TB_ESTOP_PRESSED; break;
    case 'P': follows = true; break;
    case 'p': follows = false; inputs &= ~TB_PATTERN_UP; break;
    default: break;
    }
}

static int send_all(int file, const char *bytes, size_t length)
{
    while (length > 0U) {
        const ssize_t sent = write(file, bytes, length);
        if (sent < 0 && errno != EINTR) {
            return -1;
        }
        if (sent > 0) {
            bytes += sent;
            length -= (size_t)sent;
        }
    }
    return 0;
}

/* Let the core look, and tell of outputs that changed. */
static void look(uint64_t since, uint64_t offset)
{
    const uint32_t before = outputs;
    outputs = tb_poll(&box, (uint32_t)(since + offset), inputs);
    if (follows) {
        inputs &= ~TB_PATTERN_UP;
        inputs |= outputs & TB_PROJECTOR_GATE ? TB_PATTERN_UP : 0U;
    }
    if (telling && outputs != before) {
        tell(since);
    }
}

/* Handle what came in one read; returns -1 when the far end is gone. */
static int receive(int from, int to, uint64_t since, uint64_t offset)
{
    unsigned char bytes[256];
    char reply[TB_REPLY];
    ssize_t i;
    const ssize_t got = read(from, bytes, sizeof bytes);
    if (got <= 0) {
        return -1;
    }
    for (i = 0; i < got; i++) {
        const size_t length =
            tb_receive(&box, (uint32_t)(since + offset), inputs, bytes[i], reply);
        look(since, offset); /* an answer never comes before its pulse */
        if (length > 0U && send_all(to, reply, length) < 0) {
            return -1;
        }
    }
    return 0;
}

/* A raw terminal, its path on stdout. The far end stays open here, between two clients, too. */
static int terminal(void)
{
    struct termios raw;
    const char *path;
    int far;
    const int near = posix_openpt(O_RDWR | O_NOCTTY);
    if (near < 0 || grantpt(near) < 0 || unlockpt(near) < 0 || (path = ptsname(near)) == NULL) {
        return -1;
    }
    far = open(path, O_RDWR | O_NOCTTY);
    if (far < 0 || tcgetattr(far, &raw) < 0) {
        return -1;
    }
    raw.c_iflag &= ~(tcflag_t)(BRKINT | ICRNL | IGNCR | INLCR | INPCK | ISTRIP | IXON);
    raw.c_oflag &= ~(tcflag_t)OPOST;
    raw.c_lflag &= ~(tcflag_t)(ECHO | ECHONL | ICANON | IEXTEN | ISIG);
    if (tcsetattr(far, TCSANOW, &raw) < 0) {
        return -1;
    }
    printf("%s\n", path);
    fflush(stdout);
    return near;
}

int main(int count, char **arguments)
{
    const uint64_t start = microseconds();
    uint64_t offset = 0;
    int wire;
    const bool alone = count > 1 && strcmp(arguments[1], "-") == 0;
    if (count > 2 + alone) {
        fprintf(stderr, "usage: host [-] [clock]\n");
        return 2;
    }
    if (count > 1 + alone) {
        offset = strtoull(arguments[1 + alone], NULL, 10);
    }
    telling = !alone;
    wire = alone ? STDIN_FILENO : terminal();
    if (wire < 0) {
        fprintf(stderr, "host: cannot make a terminal: %s\n", strerror(errno));
        return 1;
    }
    tb_init(&box);
    for (;;) {
        struct pollfd files[2];
        const uint64_t since = microseconds() - start;
        files[0].fd = wire;
        files[1].fd = telling ? STDIN_FILENO : -1;
        files[0].events = files[1].events = POLLIN;
        files[0].revents = files[1].revents = 0;
        /* With a table running a short look; else a nap, so that an idle box costs nothing. */
        if (poll(files, 2, box.state == TB_RUNNING || outputs != 0U ? 0 : 1) < 0) {
            return 1;
        }
        if (files[1].revents != 0) {
            char letter;
            if (read(STDIN_FILENO, &letter, 1) <= 0) {
                return 0;
            }
            steer(letter);
        }
        if (files[0].revents != 0 &&
            receive(wire, telling ? wire : STDOUT_FILENO, since, offset) < 0) {
            return 0;
        }
        look(since, offset);
    }
}
