static void begin_$s(model *m) {
  for (int i = 0; i < $count; i++) {
    ${name}_start(&m->peer$s[i]);
    ${name}_unheard(&m->in$s[i]);
    m->stage$s[i] = 0;
  }
}

static long long next_$s(const model *m, long long at) {
  for (int i = 0; i < $count; i++) {
    const $name *p = &m->peer$s[i];
    const long long next = m->stage$s[i] == 2 ? ${name}_next(p) : p->quanta;
    if (next < at) at = next;
  }
  return at;
}

static void move_$s(model *m, long long at) {
  for (int i = 0; i < $count; i++)
    if (m->stage$s[i] == 2 && ${name}_next(&m->peer$s[i]) == at) {
      ${name}_move(&m->peer$s[i]);
      m->stage$s[i] = 0;
    }
}

static void send_$s(model *m, long long at) {
  static const int numbers[$count] = {$numbers};
  (void)numbers;
  for (int i = 0; i < $count; i++)
    if (m->stage$s[i] == 0 && m->peer$s[i].quanta == at) {
      ${name}_send(&m->peer$s[i], &m->in$s[i], &m->out$s[i]);
$posted      m->stage$s[i] = 1;
    }
}

static void force_$s(model *m, long long at) {
  for (int i = 0; i < $count; i++)
    if (m->stage$s[i] == 1 && m->peer$s[i].quanta == at) {
$heard      ${name}_force(&m->peer$s[i], &m->in$s[i], &m->out$s[i]);
      m->stage$s[i] = 2;
    }
}

