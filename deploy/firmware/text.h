/* Requests and replies as text, without stdio. */
#ifndef HAIRSTAGE_TRIGGER_TEXT_H
#define HAIRSTAGE_TRIGGER_TEXT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define TB_WORDS 7U /* most words of a request */

/* A reply in the making, at most TB_REPLY characters; what is more is cut off. */
typedef struct {
    char *at;
    size_t length;
} text;

void put(text *out, char c);
void say(text *out, const char *words);
void say_number(text *out, uint32_t value);
void say_crc(text *out, uint32_t value); /* 8 hexadecimal digits */

bool same(const char *a, const char *b);

/* A whole number of digits alone, `low` to `high`. */
bool number(const char *word, uint32_t low, uint32_t high, uint32_t *value);

/* Split at single blanks, in place; returns the number of words, TB_WORDS + 1 for too many. */
size_t split(char *line, char *words[TB_WORDS]);

/* CRC-32 (IEEE) of what `crc` is the checksum of, 0 for nothing, and these bytes. */
uint32_t crc32_of(uint32_t crc, const char *bytes, size_t length);

#endif
