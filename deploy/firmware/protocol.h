/* The trigger box: its line protocol (docs/reference/wire.md) and the table that it clocks.
 *
 * Portable C99 without an operating system: no heap, no stdio, no clock of its own. The board hands
 * in time, inputs and received bytes, and puts out what `tb_poll` returns:
 *
 *     for (;;) {
 *         now = microseconds(); in = read_inputs(); length = 0;
 *         if (byte_received) length = tb_receive(&box, now, in, byte, reply);
 *         write_outputs(tb_poll(&box, now, in));
 *         if (length) send(reply, length);       an answer never comes before its pulse
 *     }
 *
 * `now_us` may wrap at 2^32 (after 71 minutes): only differences of at most a minute are taken, as
 * long as the loop itself is never held up that long.
 */
#ifndef HAIRSTAGE_TRIGGER_PROTOCOL_H
#define HAIRSTAGE_TRIGGER_PROTOCOL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define TB_ROWS 4096U          /* rows of the table, 16 bytes each */
#define TB_LINE 96U        /* longest request, without its newline */
#define TB_REPLY 97U       /* longest reply, with its newline */

/* Inputs, a bit each. */
#define TB_INTERLOCK_OPEN 1U
#define TB_ESTOP_PRESSED 2U
#define TB_PATTERN_UP 4U   /* the projectors' trigger-out */

/* Outputs, a bit each. */
#define TB_LIGHT_GATE 1U
#define TB_PROJECTOR_GATE 2U
#define TB_CAMERAS 4U

typedef enum { TB_IDLE, TB_ARMED, TB_RUNNING, TB_DONE, TB_STOPPED } tb_state;
typedef enum { TB_NEXT, TB_PATTERN_DOWN, TB_PATTERN, TB_SETTLE, TB_EXPOSE } tb_phase;
typedef enum {
    TB_NO_REASON, TB_BY_STOP, TB_BY_WATCHDOG, TB_BY_INTERLOCK, TB_BY_ESTOP, TB_NO_PATTERN
} tb_reason;

typedef struct {
    uint32_t repeat;           /* with the gates' bits from TB_GATES_SHIFT on */
    uint32_t settle_us, exposure_us, period_us;
} tb_row;
#define TB_GATES_SHIFT 20      /* repeat is less than 2^20 */

/* Everything the box knows; set up by `tb_init`, read by nobody else. */
typedef struct {
    uint32_t outputs;
    uint32_t count;            /* pulses since reset */
    uint32_t camera_since, camera_us;

    tb_state state;
    tb_phase phase;
    tb_reason reason;
    uint32_t row, repeated;    /* where the table is */
    uint32_t steps, pulses;    /* since GO */
    uint32_t phase_began;
    uint32_t step_began;       /* when it was due: lateness of polling must not add up */
    uint32_t wait_us;          /* from `step_began` to the next step */
    uint32_t fed, watchdog_us;

    uint32_t expected, rows;   /* of the table: announced, received */
    tb_row table[TB_ROWS];

    char line[TB_LINE + 2U];   /* room for a carriage return and a zero */
    size_t line_length;
    bool line_broken;          /* too long, or not ASCII */
} tb_box;

/* Power-up: outputs down, no table, count 0. */
void tb_init(tb_box *box);

/* Take one byte from the wire. Returns the length of the reply, which ends in a newline and has
 * no terminating zero; 0 while the request goes on. */
size_t tb_receive(tb_box *box, uint32_t now_us, uint32_t inputs, unsigned char byte,
                  char reply[TB_REPLY]);

/* Let time pass; returns the outputs as they must be now. Call it as often as you can: what a call
 * comes late, the step is late. */
uint32_t tb_poll(tb_box *box, uint32_t now_us, uint32_t inputs);

#endif
