/* The generated MAVLink headers, with what the board does not use left out. */
#ifndef ARMSIGHT_MAVLINK_SETUP_H
#define ARMSIGHT_MAVLINK_SETUP_H

#define MAVLINK_COMM_NUM_BUFFERS 1
#define MAVLINK_NO_CONVERSION_HELPERS
#define MAVLINK_NO_SIGNATURE_CHECK
#define MAVLINK_NO_SIGN_PACKET

#include <armsight/mavlink.h>

#endif
