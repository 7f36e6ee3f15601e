#include "protocol.h"

#include "table.h"
#include "text.h"

#define WATCHDOG_MS_LOW 100U
#define WATCHDOG_MS_HIGH 60000U
#define WATCHDOG_MS_DEFAULT 2000U
#define REPEATS 1000000U
#define SETTLE_US 1000000U
#define EXPOSURE_US 10000000U
#define PERIOD_US 60000000U

enum { UNKNOWN = 1, BAD_ARGUMENT = 2, UNSAFE = 3, NOT_NOW = 4 };

static const char *const STATES[] = {"idle", "armed", "running", "done", "stopped"};
static const char *const REASONS[] = {"-", "stop", "watchdog", "interlock", "estop", "no-pattern"};
static const char *const GATES[] = {"-", "L", "P", "LP"}; /* index: the gates' bits */

/* Requests: each says its reply and returns 0, or returns the error's code. */

static int pulse(tb_box *box, uint32_t now, uint32_t inputs, const char *exposure, text *reply)
{
    uint32_t exposure_us;
    if (!number(exposure, 1U, EXPOSURE_US, &exposure_us)) {
        return BAD_ARGUMENT;
    }
    if (box->state == TB_RUNNING) {
        return NOT_NOW;
    }
    if ((inputs & (TB_INTERLOCK_OPEN | TB_ESTOP_PRESSED)) != 0U) {
        return UNSAFE;
    }
    tb_fire(box, now, exposure_us);
    say(reply, "OK ");
    say_number(reply, box->count);
    return 0;
}

static int reset(tb_box *box, text *reply)
{
    if (box->state == TB_RUNNING) {
        return NOT_NOW;
    }
    box->count = 0;
    say(reply, "OK 0");
    return 0;
}

static void forget_run(tb_box *box, tb_state state)
{
    box->state = state;
    box->reason = TB_NO_REASON;
    box->steps = box->pulses = 0;
}

static int begin_table(tb_box *box, const char *count, text *reply)
{
    uint32_t rows;
    if (box->state == TB_RUNNING) {
        return NOT_NOW;
    }
    if (!number(count, 1U, TB_ROWS, &rows)) {
        return BAD_ARGUMENT;
    }
    forget_run(box, TB_IDLE);
    box->expected = rows;
    box->rows = 0;
    say(reply, "OK TABLE ");
    say_number(reply, rows);
    return 0;
}

/* `words`: ROW, index, repeat, gates, settle, exposure, period. */
static int take_row(tb_box *box, char *words[TB_WORDS], text *reply)
{
    tb_row row;
    uint32_t index, repeat, gates = 0;
    if (box->state == TB_RUNNING || box->state == TB_ARMED || box->rows >= box->expected) {
        return NOT_NOW;
    }
    while (gates < 4U && !same(words[3], GATES[gates])) {
        gates++;
    }
    if (gates == 4U || !number(words[1], box->rows, box->rows, &index) ||
        !number(words[2], 1U, REPEATS, &repeat) ||
        !number(words[4], 0U, SETTLE_US, &row.settle_us) ||
        !number(words[5], 1U, EXPOSURE_US, &row.exposure_us) ||
        !number(words[6], 0U, PERIOD_US, &row.period_us)) {
        return BAD_ARGUMENT;
    }
    row.repeat = repeat | gates << TB_GATES_SHIFT;
    box->table[box->rows++] = row;
    say(reply, "OK ROW ");
    say_number(reply, index);
    return 0;
}

static uint32_t crc_of_row(uint32_t crc, const tb_row *row)
{
    char bytes[TB_REPLY];
    text out = {bytes, 0};
    say_number(&out, tb_repeat(row));
    put(&out, ' ');
    say(&out, GATES[tb_gates(row)]);
    put(&out, ' ');
    say_number(&out, row->settle_us);
    put(&out, ' ');
    say_number(&out, row->exposure_us);
    put(&out, ' ');
    say_number(&out, row->period_us);
    put(&out, '\n');
    return crc32_of(crc, out.at, out.length);
}

static int arm(tb_box *box, text *reply)
{
    uint32_t i, steps = 0, crc = 0;
    if (box->state == TB_RUNNING || box->expected == 0U || box->rows < box->expected) {
        return NOT_NOW;
    }
    for (i = 0; i < box->rows; i++) {
        steps += tb_repeat(&box->table[i]);
        crc = crc_of_row(crc, &box->table[i]);
    }
    forget_run(box, TB_ARMED);
    say(reply, "OK ARM ");
    say_number(reply, steps);
    put(reply, ' ');
    say_crc(reply, crc);
    return 0;
}

static int go(tb_box *box, uint32_t now, uint32_t inputs, text *reply)
{
    if (box->state != TB_ARMED) {
        return NOT_NOW;
    }
    if ((inputs & (TB_INTERLOCK_OPEN | TB_ESTOP_PRESSED)) != 0U) {
        return UNSAFE;
    }
    tb_start(box, now);
    say(reply, "OK GO");
    return 0;
}

static int say_progress(const tb_box *box, text *reply)
{
    say(reply, "SEQ ");
    say(reply, STATES[box->state]);
    put(reply, ' ');
    say_number(reply, box->steps);
    put(reply, ' ');
    say_number(reply, box->pulses);
    put(reply, ' ');
    say(reply, REASONS[box->reason]);
    return 0;
}

static int stop_table(tb_box *box, text *reply)
{
    tb_stop(box, TB_BY_STOP);
    if (box->state == TB_ARMED) {
        box->state = TB_IDLE;
    }
    say(reply, "OK STOP ");
    say_number(reply, box->steps);
    return 0;
}

static int set_watchdog(tb_box *box, const char *time, text *reply)
{
    uint32_t ms;
    if (!number(time, WATCHDOG_MS_LOW, WATCHDOG_MS_HIGH, &ms)) {
        return BAD_ARGUMENT;
    }
    box->watchdog_us = ms * 1000U;
    say(reply, "OK WATCHDOG ");
    say_number(reply, ms);
    return 0;
}

static int carry_out(tb_box *box, uint32_t now, uint32_t inputs, text *reply)
{
    char *words[TB_WORDS];
    const size_t n = split(box->line, words);
    const char *name = words[0];
    if (n == 1U && same(name, "ID?")) {
        say(reply, "HAIRSTAGE-TRIGGER 2 ");
        say_number(reply, TB_ROWS);
        return 0;
    }
    if (n == 1U && same(name, "COUNT?")) {
        say(reply, "COUNT ");
        say_number(reply, box->count);
        return 0;
    }
    if (n == 1U && same(name, "STATUS?")) {
        say(reply, "STATUS interlock=");
        put(reply, (inputs & TB_INTERLOCK_OPEN) != 0U ? '1' : '0');
        say(reply, " estop=");
        put(reply, (inputs & TB_ESTOP_PRESSED) != 0U ? '1' : '0');
        return 0;
    }
    if (n == 1U && same(name, "SEQ?")) {
        return say_progress(box, reply);
    }
    if (n == 1U && same(name, "STOP")) {
        return stop_table(box, reply);
    }
    if (n == 2U && same(name, "PULSE")) {
        return pulse(box, now, inputs, words[1], reply);
    }
    if (n == 1U && same(name, "RESET")) {
        return reset(box, reply);
    }
    if (n == 2U && same(name, "TABLE")) {
        return begin_table(box, words[1], reply);
    }
    if (n == 7U && same(name, "ROW")) {
        return take_row(box, words, reply);
    }
    if (n == 1U && same(name, "ARM")) {
        return arm(box, reply);
    }
    if (n == 1U && same(name, "GO")) {
        return go(box, now, inputs, reply);
    }
    if (n == 2U && same(name, "WATCHDOG")) {
        return set_watchdog(box, words[1], reply);
    }
    return UNKNOWN;
}

static void say_error(text *reply, int code)
{
    static const char *const TEXTS[] = {
        "", "unknown command", "bad argument", "interlock open or emergency stop pressed",
        "not in this state"};
    say(reply, "ERR ");
    say_number(reply, (uint32_t)code);
    put(reply, ' ');
    say(reply, TEXTS[code]);
}

void tb_init(tb_box *box)
{
    box->outputs = 0;
    box->count = 0;
    box->row = box->repeated = 0;
    box->expected = box->rows = 0;
    box->watchdog_us = WATCHDOG_MS_DEFAULT * 1000U;
    box->line_length = 0;
    box->line_broken = false;
    forget_run(box, TB_IDLE);
}

size_t tb_receive(tb_box *box, uint32_t now_us, uint32_t inputs, unsigned char byte,
                  char reply[TB_REPLY])
{
    text out = {reply, 0};
    int code = UNKNOWN;
    if (byte != '\n') {
        if (byte == 0U || byte > 127U || box->line_length > TB_LINE) {
            box->line_broken = true;
        } else {
            box->line[box->line_length++] = (char)byte;
        }
        return 0;
    }
    if (box->line_length > 0U && box->line[box->line_length - 1U] == '\r') {
        box->line_length--;
    }
    box->line[box->line_length] = '\0';
    if (!box->line_broken && box->line_length <= TB_LINE) {
        code = carry_out(box, now_us, inputs, &out);
    }
    if (code == 0) {
        box->fed = now_us; /* not by refusals: noise must not feed the watchdog */
    } else {
        say_error(&out, code);
    }
    box->line_length = 0;
    box->line_broken = false;
    put(&out, '\n');
    return out.length;
}
