# SPDX-License-Identifier: Apache-2.0
# The library as a component of ESP-IDF 5 (../../CMakeLists.txt includes it). BearSSL's folder is TEDS_BEARSSL_DIR of the
# environment. Compiled against stand-ins only: no ESP-IDF has built it yet.
set(TEDS ${CMAKE_CURRENT_LIST_DIR}/../..)
set(TEDS_BEARSSL_DIR $ENV{TEDS_BEARSSL_DIR})
if(NOT CMAKE_BUILD_EARLY_EXPANSION AND NOT EXISTS ${TEDS_BEARSSL_DIR}/inc/bearssl.h)
  message(FATAL_ERROR "Set TEDS_BEARSSL_DIR in the environment to the folder of BearSSL 0.6.")
endif()
file(STRINGS ${TEDS}/port/bearssl/sources.txt TEDS_BEARSSL_SOURCES REGEX "^[^#]")
file(STRINGS ${TEDS}/port/bearssl/flags.txt TEDS_BEARSSL_FLAGS REGEX "^[^#]")
list(TRANSFORM TEDS_BEARSSL_SOURCES PREPEND "${TEDS_BEARSSL_DIR}/")
file(GLOB TEDS_SOURCES ${TEDS}/src/*.c)

idf_component_register(
  SRCS ${TEDS_SOURCES} ${TEDS}/port/bearssl/teds_bearssl.c ${TEDS}/port/esp32/teds_esp32.c ${TEDS_BEARSSL_SOURCES}
  INCLUDE_DIRS ${TEDS}/include ${TEDS}/port/bearssl ${TEDS}/port/esp32
  PRIV_INCLUDE_DIRS ${TEDS}/src ${TEDS_BEARSSL_DIR}/inc ${TEDS_BEARSSL_DIR}/src
  REQUIRES driver esp_partition esp_timer esp_hw_support bootloader_support)
target_compile_definitions(${COMPONENT_LIB} PUBLIC TEDS_CAN_FD=0) # TWAI of the ESP32 knows no FD
set_source_files_properties(${TEDS_BEARSSL_SOURCES} PROPERTIES COMPILE_OPTIONS "${TEDS_BEARSSL_FLAGS}")
