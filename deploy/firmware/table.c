#include "table.h"

#define TRIGGER_US 100U            /* longest trigger pulse */
#define TRIGGER_OUT_US 100000U     /* how long the projectors' trigger-out may take */

uint32_t tb_repeat(const tb_row *row)
{
    return row->repeat & ((1UL << TB_GATES_SHIFT) - 1U);
}

uint32_t tb_gates(const tb_row *row)
{
    return row->repeat >> TB_GATES_SHIFT;
}

static void close_gates(tb_box *box)
{
    box->outputs &= ~(TB_LIGHT_GATE | TB_PROJECTOR_GATE);
}

void tb_stop(tb_box *box, tb_reason reason)
{
    close_gates(box);
    if (box->state == TB_RUNNING) {
        box->state = TB_STOPPED;
        box->reason = reason;
    }
}

void tb_fire(tb_box *box, uint32_t now, uint32_t exposure_us)
{
    box->outputs |= TB_CAMERAS;
    box->camera_since = now;
    box->camera_us = exposure_us < TRIGGER_US ? exposure_us : TRIGGER_US;
    box->count++;
}

static void enter(tb_box *box, tb_phase phase, uint32_t now)
{
    box->phase = phase;
    box->phase_began = now;
}

/* The step's gates have closed: the next one follows, or the table is done. */
static void end_step(tb_box *box, uint32_t now)
{
    const tb_row *row = &box->table[box->row];
    const bool overdue = now - box->step_began >= row->period_us;
    box->wait_us = overdue ? 0U : row->period_us;
    if (overdue) {
        box->step_began = now;
    }
    close_gates(box);
    box->steps++;
    box->repeated++;
    if (box->repeated == tb_repeat(row)) {
        box->repeated = 0;
        box->row++;
    }
    if (box->row == box->rows) {
        box->state = TB_DONE;
    }
    enter(box, TB_NEXT, now);
}

static void advance(tb_box *box, uint32_t now, uint32_t inputs)
{
    const tb_row *row = &box->table[box->row];
    const uint32_t elapsed = now - box->phase_began;
    const bool projects = (tb_gates(row) & TB_PROJECTOR_GATE) != 0U;
    const bool up = (inputs & TB_PATTERN_UP) != 0U;
    switch (box->phase) {
    case TB_NEXT:
        if (now - box->step_began >= box->wait_us) {
            box->step_began += box->wait_us;
            enter(box, TB_PATTERN_DOWN, now);
        }
        break;
    case TB_PATTERN_DOWN:
        if (!projects || !up) {
            box->outputs |= tb_gates(row);
            enter(box, projects ? TB_PATTERN : TB_SETTLE, now);
        } else if (elapsed >= TRIGGER_OUT_US) {
            tb_stop(box, TB_NO_PATTERN);
        }
        break;
    case TB_PATTERN:
        if (up) {
            enter(box, TB_SETTLE, now);
        } else if (elapsed >= TRIGGER_OUT_US) {
            tb_stop(box, TB_NO_PATTERN);
        }
        break;
    case TB_SETTLE:
        if (elapsed >= row->settle_us) {
            tb_fire(box, now, row->exposure_us);
            box->pulses++;
            enter(box, TB_EXPOSE, now);
        }
        break;
    case TB_EXPOSE:
        if (elapsed >= row->exposure_us) {
            end_step(box, now);
        }
        break;
    }
}

void tb_start(tb_box *box, uint32_t now)
{
    box->state = TB_RUNNING;
    box->row = box->repeated = 0;
    box->step_began = now;
    box->wait_us = 0;
    enter(box, TB_NEXT, now);
}

uint32_t tb_poll(tb_box *box, uint32_t now_us, uint32_t inputs)
{
    if ((box->outputs & TB_CAMERAS) != 0U && now_us - box->camera_since >= box->camera_us) {
        box->outputs &= ~TB_CAMERAS;
    }
    if (box->state == TB_RUNNING) {
        if ((inputs & TB_ESTOP_PRESSED) != 0U) {
            tb_stop(box, TB_BY_ESTOP);
        } else if ((inputs & TB_INTERLOCK_OPEN) != 0U) {
            tb_stop(box, TB_BY_INTERLOCK);
        } else if (now_us - box->fed > box->watchdog_us) {
            tb_stop(box, TB_BY_WATCHDOG);
        } else {
            advance(box, now_us, inputs);
        }
    }
    return box->outputs;
}
