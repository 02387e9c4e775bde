/* What the host asks for, acknowledged or rejected. Tick context. */
#ifndef ARMSIGHT_COMMAND_H
#define ARMSIGHT_COMMAND_H

#include "types.h"

/* Execute this tick's command wholly, or reject it and change nothing; either is recorded with its sequence number. */
void command_take(core_state *core, const core_inputs *inputs);

#endif
