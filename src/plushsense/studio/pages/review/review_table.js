// A table of recordings as plain HTML, for screen readers and keyboards.
export default {
  template: `
    <table class="ps-table">
      <caption>{{ caption }}</caption>
      <thead><tr>
        <th scope="col" class="ps-check"><input type="checkbox" :checked="all" :aria-label="pick" data-test="select-page"
            @click.prevent="$emit('page')"></th>
        <th v-for="c in columns" :key="c.key" scope="col"
            :aria-sort="c.key === sort ? (down ? 'descending' : 'ascending') : undefined">
          <button v-if="c.sorts" type="button" @click="$emit('sort', c.key)">{{ c.label
            }}<span aria-hidden="true">{{ c.key === sort ? (down ? ' ▼' : ' ▲') : '' }}</span></button>
          <span v-else>{{ c.label }}</span>
        </th>
      </tr></thead>
      <tbody>
        <tr v-for="r in rows" :key="r.id" :aria-current="r.id === current ? 'true' : undefined">
          <td class="ps-check"><input type="checkbox" :checked="r.selected" :aria-label="pick + ': ' + r.id"
              @click.prevent="$emit('pick', { id: r.id, shift: $event.shiftKey })"></td>
          <th scope="row"><button type="button" class="ps-open" @click="$emit('open', r.id)">{{ r.id }}</button></th>
          <td>{{ r.person }}</td>
          <td>{{ r.gesture }}<span v-if="r.recorded" class="ps-recorded">{{ r.recorded }}</span></td>
          <td class="ps-number">{{ r.seconds }}</td>
          <td><span v-for="f in r.findings" class="ps-finding" :data-severity="f.severity">{{ f.text }}</span></td>
          <td><span class="ps-state" :data-state="r.state">{{ r.state_text }}</span></td>
          <td><svg class="ps-spark" viewBox="0 0 100 24" preserveAspectRatio="none" role="img" :aria-label="spark">
            <rect v-if="r.kept" :x="r.kept[0]" y="0" :width="r.kept[1] - r.kept[0]" height="24" class="ps-kept"/>
            <polyline :points="r.points"/></svg></td>
        </tr>
      </tbody>
    </table>`,
  computed: {
    all() {
      return this.rows.length > 0 && this.rows.every((r) => r.selected);
    },
  },
  props: { pick: String, caption: String, columns: Array, rows: Array, sort: String, down: Boolean, current: String, spark: String },
};
