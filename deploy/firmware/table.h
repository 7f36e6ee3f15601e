/* The table and its clock; `tb_poll`, in protocol.h, moves it on. */
#ifndef HAIRSTAGE_TRIGGER_TABLE_H
#define HAIRSTAGE_TRIGGER_TABLE_H

#include "protocol.h"

uint32_t tb_repeat(const tb_row *row);
uint32_t tb_gates(const tb_row *row); /* TB_LIGHT_GATE | TB_PROJECTOR_GATE */

/* Fire the cameras now, and count. */
void tb_fire(tb_box *box, uint32_t now, uint32_t exposure_us);

/* Run the table from its first step. */
void tb_start(tb_box *box, uint32_t now);

/* Close the gates; a table that runs is stopped for `reason`. */
void tb_stop(tb_box *box, tb_reason reason);

#endif
