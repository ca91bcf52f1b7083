/* With glibc a WIDE loop is also made for processors with wider registers, and chosen when the module is loaded. */
#ifndef SCROLL_TACTILE_WIDE_H
#define SCROLL_TACTILE_WIDE_H

#include <limits.h> /* of glibc, if it is that */

#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__) && !defined(__SANITIZE_ADDRESS__)
#define WIDE __attribute__((target_clones("avx2", "default")))
#else
#define WIDE
#endif

#ifdef __cplusplus
#define restrict __restrict
#endif

#endif
